"""The whole path on a GPU equals that on the CPU, on LM-O's geometry."""

import pytest
import pytorch_lightning as pl
import torch

from foundpose.bop import BopDataset, ground_truth_instances, score_results
from foundpose.bop.pictures import TrueCoordinates
from foundpose.evaluation.data import PoseDataModule
from foundpose.evaluation.module import PoseEvaluation, estimate_dataset
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import to_results
from foundpose.evaluation.report import all_records, merge_shards
from foundpose.features import CoordinateCode
from foundpose.geometry import SuperFibonacci, rotation_angle
from foundpose.onboarding import Onboarder, RepresentationStore
from foundpose.rendering import CoordinateRenderer
from foundpose.retrieval import SoftAssignBow, VisualWords
from tests.pipeline.test_foundpose import make_pipeline


@pytest.mark.gpu
def test_cuda_equals_the_cpu(lmo_root, tmp_path):
    dataset = BopDataset(lmo_root)
    onboarder = Onboarder(
        CoordinateRenderer(), CoordinateCode(), SuperFibonacci(400), VisualWords(1024), SoftAssignBow()
    )
    store = RepresentationStore(tmp_path / "representations", onboarder)
    DatasetObjects(dataset, store).onboard(dataset.object_ids)
    records, recalls = [], []
    for accelerator in ("cpu", "gpu"):
        folder = tmp_path / accelerator
        objects = DatasetObjects(dataset, store)
        data = PoseDataModule(dataset, ground_truth_instances, objects, folder, TrueCoordinates())
        trainer = pl.Trainer(
            accelerator=accelerator,
            devices=1,
            inference_mode=False,
            use_distributed_sampler=False,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
        )
        module = PoseEvaluation(make_pipeline(), objects, folder)
        estimate_dataset(trainer, module, data)
        if accelerator == "gpu":
            assert trainer.strategy.root_device.type == "cuda"
        records.append(all_records(merge_shards(folder, data.batches)))
        scores = score_results(dataset, to_results(records[-1]), errors=("mssd", "mspd"))
        recalls.append([scores.average_recall(name) for name in ("mssd", "mspd")])
    R = [torch.tensor([r["R"] for r in part]) for part in records]
    t = [torch.tensor([r["t"] for r in part]) for part in records]
    assert len(R[0]) == 365
    angle = torch.rad2deg(rotation_angle(R[0], R[1]))
    same = (angle < 0.1) & ((t[0] - t[1]).norm(dim=1) < 0.002 * t[0].norm(dim=1))
    assert same.double().mean() >= 0.99
    assert torch.allclose(torch.tensor(recalls[0]), torch.tensor(recalls[1]), atol=0.002)

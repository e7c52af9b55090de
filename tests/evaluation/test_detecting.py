import json
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from foundpose.bop import BopDataset, detected_instances, detection_scores
from foundpose.bop.pictures import Photographs
from foundpose.detection import Detections
from foundpose.evaluation.detecting import detect_dataset, detection_entries


class Truth(nn.Module):
    """Detects the ground truth, and the whole picture with less confidence."""

    def __init__(self, dataset: BopDataset) -> None:
        super().__init__()
        self.dataset = dataset
        self.calls = 0

    def forward(self, images: Tensor, K: Tensor, objects: list, names: list) -> Detections:
        self.calls += 1
        ((scene_id, im_id),) = names
        (annotation,) = self.dataset.annotations(scene_id, im_id)
        mask = self.dataset.visible_mask(scene_id, im_id, annotation.index)
        masks = torch.stack([mask, torch.ones_like(mask)])
        label = self.dataset.object_ids.index(annotation.obj_id)
        return Detections(masks, torch.tensor([0.75, 0.25]), torch.zeros(2).long(), torch.full((2,), label))


class Objects:
    """As many stand-ins for representations as the dataset has objects."""

    def __init__(self, dataset: BopDataset) -> None:
        self.dataset = dataset

    def representations(self, ids: list[int], device: torch.device) -> list:
        words = type("Representation", (), {"words": torch.zeros(1, device=device)})
        return [words() for _ in ids]


def test_detections_of_a_dataset(tiny_bop: Path, tmp_path: Path) -> None:
    dataset = BopDataset(tiny_bop)
    detector = Truth(dataset)
    arguments = (detector, Objects(dataset), Photographs(), dataset.images(), dataset.object_ids, tmp_path)
    path = detect_dataset(*arguments)
    assert detector.calls == 3
    scores = detection_scores(dataset, path, kinds=["segm"])
    assert scores.to_json()["segm"]["AP"] == pytest.approx(1.0)
    instances = detected_instances(dataset, path)
    assert [instance.score for instance in instances] == [0.75] * 3
    assert torch.equal(instances[0].mask(dataset), dataset.visible_mask(1, 0, 0))
    assert all(0 < entry["time"] < 60 for entry in json.loads(path.read_text()))

    # What is there is not repeated, what is missing is done.
    (tmp_path / "detections" / "000001_000001.json").unlink()
    before = path.read_text()
    detect_dataset(*arguments)
    assert detector.calls == 4
    strip = [{k: v for k, v in entry.items() if k != "time"} for entry in json.loads(path.read_text())]
    assert strip == [{k: v for k, v in entry.items() if k != "time"} for entry in json.loads(before)]


def test_entries() -> None:
    masks = torch.zeros(1, 8, 9, dtype=torch.bool)
    masks[0, 2:5, 3:7] = True
    found = Detections(masks, torch.tensor([0.5]), torch.zeros(1).long(), torch.ones(1).long())
    (entry,) = detection_entries(found, [5, 8])
    assert (entry["category_id"], entry["score"], entry["bbox"]) == (8, 0.5, [3.0, 2.0, 4.0, 3.0])
    assert detection_entries(Detections(*(x[:0] for x in found)), [5, 8]) == []

"""Pose estimation of whole datasets as a Lightning module."""

import time
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import nn

from foundpose.evaluation.data import PoseBatch, PoseDataModule
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import instance_record, pose_records
from foundpose.evaluation.shards import BatchRecord, ShardWriter
from foundpose.pipeline import FoundPose
from foundpose.utils.timing import StageTimer


class PoseEvaluation(pl.LightningModule):
    """Estimates the poses of :class:`PoseDataModule`'s batches and appends each finished batch to a shard.

    Use it with ``trainer.predict``; several processes share the batches. Ground truth is not consulted.

    Args:
        pipeline: the method.
        objects: representations and, for refiners, meshes.
        folder: the run's folder; shards go into it.
        time_stages: measure every stage, which makes the program wait for the GPU around each, and not the whole
            alone.
    """

    def __init__(
        self, pipeline: FoundPose, objects: DatasetObjects, folder: str | Path, time_stages: bool = True
    ) -> None:
        super().__init__()
        self.pipeline = pipeline
        self.objects = objects
        self.folder = Path(folder)
        self.time_stages = time_stages
        self._shard: ShardWriter | None = None
        self._waiting_since = 0.0

    def on_predict_start(self) -> None:
        """Open this process's shard."""
        self._shard = ShardWriter(self.folder, self.global_rank)
        self._waiting_since = time.perf_counter()

    def predict_step(self, batch: PoseBatch, batch_idx: int) -> int:
        """Estimate the poses of a batch and write them; returns the batch's place in the plan."""
        if self._shard is None:
            raise RuntimeError("predict_step needs trainer.predict, which opens the shard")
        waiting = time.perf_counter() - self._waiting_since
        self._shard.append(self.estimate(batch, waiting))
        self._waiting_since = time.perf_counter()
        return batch.number

    def estimate(self, batch: PoseBatch, waiting: float = 0.0) -> BatchRecord:
        """Poses of a batch.

        Args:
            batch: the batch, images and masks on this module's device.
            waiting: seconds that the batch was waited for, for the record.
        """
        start = time.perf_counter()
        ids = sorted(set(batch.object_ids))
        representations = dict(zip(ids, self.objects.representations(ids, self.device), strict=True))
        seconds = {"waiting": waiting, "representations": time.perf_counter() - start}
        records: list[dict[str, Any]] = [{} for _ in batch.instances]
        pipeline = 0.0
        stages = self._stages() if self.time_stages else {}
        with StageTimer(stages) as timer:
            for members in _same_size(batch):
                poses, spent = self._run(batch, members, representations)
                pipeline += spent
                for i, pose in zip(members, poses, strict=True):
                    record = instance_record(batch.instances[i]) | pose
                    records[i] = record | {"seconds": spent / len(members)}
        seconds |= {"pipeline": pipeline} | {name: timer.seconds[name] for name in stages}
        return BatchRecord(batch.number, records, seconds)

    def _run(
        self, batch: PoseBatch, members: list[int], representations: dict[int, Any]
    ) -> tuple[list[dict[str, Any]], float]:
        """Poses of some regions, whose images have one size, and the time that took."""
        images = sorted({batch.image_index[i] for i in members})
        ids = sorted({batch.object_ids[i] for i in members})
        meshes = [self.objects.mesh(obj_id) for obj_id in ids] if self.pipeline.needs_meshes else None
        start = time.perf_counter()
        estimates = self.pipeline(
            torch.stack([batch.images[i] for i in images]),
            batch.K[images],
            [representations[obj_id] for obj_id in ids],
            masks=torch.stack([batch.masks[i] for i in members]),
            image_index=torch.tensor([images.index(batch.image_index[i]) for i in members]),
            object_index=torch.tensor([ids.index(batch.object_ids[i]) for i in members]),
            meshes=meshes,
        )
        records = pose_records(estimates)  # waits for the poses, so the clock need not
        return records, time.perf_counter() - start

    def _stages(self) -> dict[str, nn.Module]:
        stages = dict(self.pipeline.named_children())
        # By its parts, so that stages take no time twice.
        return dict(stages.pop("hypotheses").named_children()) | stages


def estimate_dataset(trainer: pl.Trainer, module: PoseEvaluation, data: PoseDataModule) -> None:
    """Run :class:`PoseEvaluation` and return when all processes have written their last batch."""
    trainer.predict(module, datamodule=data, return_predictions=False)
    trainer.strategy.barrier("all batches are written")


def _same_size(batch: PoseBatch) -> list[list[int]]:
    """Regions grouped by the size of their images, in order."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for i, image in enumerate(batch.image_index):
        groups.setdefault(tuple(batch.images[image].shape), []).append(i)
    return list(groups.values())

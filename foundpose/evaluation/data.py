"""Instances of a dataset in whole, fixed batches across images and objects, shared out among processes."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from foundpose.bop import BopDataset, Instance
from foundpose.bop.pictures import Photographs
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.shards import keep_batch_size, read_batch_size, read_shards
from foundpose.utils.batch_size import BatchSize, check_batch_size, measure_batch_size
from foundpose.utils.progress import ProgressBars

Order = Literal["image", "object"]


class PoseBatch(NamedTuple):
    """Regions of images whose poses are to be estimated.

    Attributes:
        number: place of the batch in the plan.
        images: N pictures (3, H, W) in [0, 1], each once; sizes may differ.
        K: (N, 3, 3) intrinsics, pixels.
        masks: B masks (H, W) bool, each of its image's size.
        image_index: the image of each mask, a place in ``images``.
        object_ids: the object of each mask.
        instances: what the masks are, with the detector's scores and times.
        seconds: time that reading took.
    """

    number: int
    images: tuple[Tensor, ...]
    K: Tensor
    masks: tuple[Tensor, ...]
    image_index: tuple[int, ...]
    object_ids: tuple[int, ...]
    instances: tuple[Instance, ...]
    seconds: float


def plan_batches(
    instances: Sequence[Instance], batch_size: int, order: Order = "image"
) -> list[list[Instance]]:
    """Cut instances into batches, always the same ones for the same instances.

    Args:
        instances: what to estimate.
        batch_size: instances in a batch; the last may have fewer.
        order: "image": those of an image together, so that every image is read once or twice. "object": those of an
            object together, so that few representations are in use at a time; images are read once for each object.

    Raises:
        ValueError: an argument out of range.
    """
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")
    _check_order(order)

    def key(instance: Instance) -> tuple[int, ...]:
        image = (instance.scene_id, instance.im_id)
        return image if order == "image" else (instance.obj_id, *image)

    ordered = sorted(instances, key=key)
    return [ordered[i : i + batch_size] for i in range(0, len(ordered), batch_size)]


def _check_order(order: str) -> None:
    if order not in get_args(Order):
        raise ValueError(f"order must be one of {get_args(Order)}, got {order!r}")


class InstanceBatches(Dataset[PoseBatch]):
    """Reads the batches of a plan.

    Args:
        dataset: where images, intrinsics and masks come from.
        pictures: makes the picture of an image (:class:`foundpose.bop.pictures.Photographs`, for one).
        batches: the plan.
    """

    def __init__(
        self,
        dataset: BopDataset,
        pictures: Callable[[BopDataset, int, int], Tensor],
        batches: Sequence[Sequence[Instance]],
    ) -> None:
        self.dataset = dataset
        self.pictures = pictures
        self.batches = batches
        self._last: dict[tuple[int, int], Tensor] = {}

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, index: int) -> PoseBatch:
        start = time.perf_counter()
        instances = self.batches[index]
        keys = list(dict.fromkeys((i.scene_id, i.im_id) for i in instances))
        # A batch often begins with the image that the one before ended with.
        self._last = {
            key: self._last[key] if key in self._last else self.pictures(self.dataset, *key) for key in keys
        }
        return PoseBatch(
            number=index,
            images=tuple(self._last.values()),
            K=torch.stack([self.dataset.intrinsics(*key).float() for key in keys]),
            masks=tuple(instance.mask(self.dataset) for instance in instances),
            image_index=tuple(keys.index((i.scene_id, i.im_id)) for i in instances),
            object_ids=tuple(i.obj_id for i in instances),
            instances=tuple(instances),
            seconds=time.perf_counter() - start,
        )


class BatchesOfRank(DistributedSampler[int]):
    """Every ``num_replicas``-th of the batches still to be estimated: none twice, none left out.

    A :class:`DistributedSampler` by type only, so that Lightning leaves it alone; the original repeats batches until
    all processes have equally many.

    Args:
        batches: numbers of the batches.
        num_replicas: number of processes.
        rank: number of this one.
    """

    def __init__(self, batches: Sequence[int], num_replicas: int, rank: int) -> None:
        if not 0 <= rank < num_replicas:
            raise ValueError(f"rank must lie in [0, {num_replicas}), got {rank}")
        self.batches = list(batches)[rank::num_replicas]
        # Read by those who take this for a DistributedSampler.
        self.num_replicas, self.rank, self.num_samples = num_replicas, rank, len(self.batches)
        self.shuffle, self.epoch = False, 0

    def __iter__(self) -> Iterator[int]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)


class PoseDataModule(pl.LightningDataModule):
    """What to estimate on a BOP dataset, without what an interrupted run of the same folder has estimated already.

    Missing object representations are made before the start, by one process. Ground truth is touched only by
    ``masks`` and ``pictures`` that are about it.

    Args:
        dataset: the dataset.
        masks: lists the instances of a dataset (:func:`foundpose.bop.detected_instances` with its path, for one).
        objects: representations.
        folder: the run's folder, whose shards tell what is done.
        pictures: makes pictures; the dataset's photographs by default.
        batch_size: instances in a batch; "auto" finds out before the start how many the device has memory for, and
            keeps the number in the folder, for the other processes and for runs that go on there.
        order: "image" or "object", see :func:`plan_batches`.
        object_ids: estimate only these objects.
        max_images: estimate only the first so many of the targets' images.
        num_workers: processes that read images; 0 reads them in the main process.
        prepare_data_per_node: whether each node has a file system of its own, with representations of its own.
    """

    def __init__(
        self,
        dataset: BopDataset,
        masks: Callable[[BopDataset], list[Instance]],
        objects: DatasetObjects,
        folder: str | Path,
        pictures: Callable[[BopDataset, int, int], Tensor] | None = None,
        batch_size: BatchSize = 16,
        order: Order = "image",
        object_ids: Sequence[int] | None = None,
        max_images: int | None = None,
        num_workers: int = 0,
        prepare_data_per_node: bool = False,
    ) -> None:
        super().__init__()
        check_batch_size(batch_size)
        _check_order(order)
        # Towards the end of a run there may be fewer batches than processes.
        self.allow_zero_length_dataloader_with_multiple_devices = True
        self.dataset = dataset
        self.masks = masks
        self.objects = objects
        self.folder = Path(folder)
        self.pictures = Photographs() if pictures is None else pictures
        self.batch_size: BatchSize = batch_size
        self.order: Order = order
        self.object_ids = object_ids
        self.max_images = max_images
        self.num_workers = num_workers
        self.prepare_data_per_node = prepare_data_per_node
        self._instances: list[Instance] | None = None
        self._batches: list[list[Instance]] | None = None
        self._remaining: list[int] | None = None

    @property
    def instances(self) -> list[Instance]:
        """What to estimate.

        Raises:
            ValueError: there is nothing.
        """
        if self._instances is None:
            wanted = set(self.dataset.object_ids if self.object_ids is None else self.object_ids)
            images = set(self.dataset.images()[: self.max_images])
            self._instances = [
                i for i in self.masks(self.dataset) if i.obj_id in wanted and (i.scene_id, i.im_id) in images
            ]
            if not self._instances:
                raise ValueError(
                    f"nothing to estimate: the masks have no instance of the objects {sorted(wanted)} in the "
                    f"{len(images)} images of {self.dataset.targets_path}"
                )
        return self._instances

    @property
    def batches(self) -> list[list[Instance]]:
        """The plan.

        Raises:
            ValueError: there is nothing to estimate.
            RuntimeError: the size of batches is to be found out, which happens in :meth:`prepare_data`.
        """
        if self._batches is None:
            batch_size = read_batch_size(self.folder) if self.batch_size == "auto" else self.batch_size
            self._batches = plan_batches(self.instances, batch_size, self.order)
        return self._batches

    def prepare_data(self) -> None:
        """Onboard the objects that are not onboarded yet, on the trainer's device, and find the size of batches."""
        device = torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device
        self.objects.store.onboarder.to(device)
        ids = sorted({instance.obj_id for instance in self.instances})
        self.objects.onboard(ids, ProgressBars)
        if self.batch_size == "auto":
            keep_batch_size(self.folder, lambda: self._measure_batch_size(device))

    def _measure_batch_size(self, device: torch.device) -> int:
        """How many instances the module that predicts can take at a time."""
        estimate = None if self.trainer is None else getattr(self.trainer.lightning_module, "estimate", None)
        if self.trainer is None or estimate is None:
            raise RuntimeError("batch_size='auto' needs trainer.predict with a PoseEvaluation to try")
        self.trainer.lightning_module.to(device).eval()
        first = plan_batches(self.instances, len(self.instances), self.order)[0]

        def run(samples: int) -> None:
            # A short dataset fills a batch by repeating itself.
            batch = [first[i % len(first)] for i in range(samples)]
            read = InstanceBatches(self.dataset, self.pictures, [batch])[0]
            with torch.no_grad():
                estimate(self.transfer_batch_to_device(read, device, 0))

        processes = self.trainer.num_devices if device.type == "cpu" else 1
        # Every process is to get a batch.
        share = len(self.instances) // self.trainer.world_size
        return measure_batch_size(run, device, processes, share)

    def setup(self, stage: str) -> None:
        """Find out what remains to be done.

        Raises:
            ValueError: a batch's objects exceed the memory limit, or the folder's shards do not fit.
        """
        self.objects.check_limit({tuple(sorted({i.obj_id for i in batch})) for batch in self.batches})
        done = read_shards(self.folder, self.batches)
        self._remaining = [i for i in range(len(self.batches)) if i not in done]

    def predict_dataloader(self) -> DataLoader[PoseBatch]:
        """Batches of this process that are not done yet."""
        if self._remaining is None:
            self.setup("predict")
        assert self._remaining is not None
        world, rank = (1, 0) if self.trainer is None else (self.trainer.world_size, self.trainer.global_rank)
        return DataLoader(
            InstanceBatches(self.dataset, self.pictures, self.batches),
            batch_size=None,
            sampler=BatchesOfRank(self._remaining, world, rank),
            num_workers=self.num_workers,
        )

    def transfer_batch_to_device(
        self, batch: PoseBatch, device: torch.device, dataloader_idx: int
    ) -> PoseBatch:
        """Move images, intrinsics and masks."""
        return batch._replace(
            images=tuple(image.to(device) for image in batch.images),
            K=batch.K.to(device),
            masks=tuple(mask.to(device) for mask in batch.masks),
        )

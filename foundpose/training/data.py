"""Lightning's view of the pairs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader, Sampler

from foundpose.geometry import PerspectiveCrop, Symmetries
from foundpose.onboarding import Onboarder, Progress
from foundpose.rendering import Mesh
from foundpose.synthetic import combine_seeds
from foundpose.training.pairs import PairBatch, PairSettings, PatchPairs, make_pairs


class EpochShuffle(Sampler[int]):
    """A random order that depends on seed and epoch alone, so that a resumed training goes on as it would have.

    Args:
        count: number of items.
        seed: of the order.
    """

    def __init__(self, count: int, seed: int) -> None:
        self.count = count
        self.seed = seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before every epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[int]:
        generator = torch.Generator().manual_seed(combine_seeds(self.seed, self.epoch))
        return iter(torch.randperm(self.count, generator=generator).tolist())


class PairDataModule(pl.LightningDataModule):
    """Renders and describes pairs of crop and template once, at first need, and deals them out in batches.

    Args:
        meshes: objects to train on.
        validation_meshes: other objects, for the validation loss; may be empty.
        onboarder: renders templates; its extractor describes all patches.
        crop: cuts the crops.
        pairs: what the pairs are made of.
        batch_size: pairs in a batch.
        seed: of scenes, templates and the order of the pairs.
        cache: folder to keep the described pairs in, or None.
        progress: is told how far rendering has come.
        symmetries: of the meshes to train on, one entry each; None: they have none.
        validation_symmetries: of the others.

    Raises:
        ValueError: no meshes or no batch.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        validation_meshes: Sequence[Mesh],
        onboarder: Onboarder,
        crop: PerspectiveCrop,
        pairs: PairSettings,
        batch_size: int = 16,
        seed: int = 0,
        cache: str | Path | None = None,
        progress: Progress | None = None,
        symmetries: Symmetries | None = None,
        validation_symmetries: Symmetries | None = None,
    ) -> None:
        super().__init__()
        if not meshes:
            raise ValueError("meshes is empty: give at least one to train on")
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self.meshes = list(meshes)
        self.validation_meshes = list(validation_meshes)
        self.onboarder = onboarder
        self.crop = crop
        self.pairs = pairs
        self.batch_size = batch_size
        self.seed = seed
        self.cache = None if cache is None else Path(cache)
        self.progress = progress
        self.symmetries = symmetries
        self.validation_symmetries = validation_symmetries
        self.training: PatchPairs | None = None
        self.validation: PatchPairs | None = None

    def setup(self, stage: str | None = None) -> None:
        """Make the pairs."""
        if self.training is None:
            self.training = self._make(self.meshes, self.seed, self.symmetries)
        if self.validation is None and self.validation_meshes:
            self.validation = self._make(self.validation_meshes, self.seed + 1, self.validation_symmetries)

    def _make(self, meshes: Sequence[Mesh], seed: int, symmetries: Symmetries | None) -> PatchPairs:
        return make_pairs(
            meshes, self.onboarder, self.crop, self.pairs, seed, self.cache, self.progress, symmetries
        )

    def train_dataloader(self) -> DataLoader[PairBatch]:
        """All training pairs in a new order each epoch.

        Raises:
            RuntimeError: :meth:`setup` has not been called; Lightning's trainer does.
        """
        if self.training is None:
            raise RuntimeError("there are no pairs yet: call setup() before train_dataloader()")
        sampler = EpochShuffle(len(self.training), self.seed)
        return DataLoader(self.training, self.batch_size, sampler=sampler, collate_fn=_as_it_is)

    def val_dataloader(self) -> list[DataLoader[PairBatch]]:
        """All validation pairs, or nothing."""
        if self.validation is None:
            return []
        return [DataLoader(self.validation, self.batch_size, collate_fn=_as_it_is)]


def _as_it_is(batch: Any) -> Any:
    """The data set makes batches itself."""
    return batch

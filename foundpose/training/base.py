"""What the trainings share: the order of the data, the data module, the optimiser."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import pytorch_lightning as pl
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset, Sampler

from foundpose.rendering import Mesh
from foundpose.synthetic import combine_seeds


class EpochShuffle(Sampler[int]):
    """Each epoch all items in an order that depends on seed and epoch alone: a resumed training goes on as it would.

    Item ``k`` is item ``k % count`` for the ``k // count``-th time, for data that draw something anew each time.

    Args:
        count: number of items.
        seed: of the order.
        passes: how often each item is shown in an epoch.
    """

    def __init__(self, count: int, seed: int, passes: int = 1) -> None:
        self.count = count
        self.seed = seed
        self.passes = passes
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before every epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count * self.passes

    def __iter__(self) -> Iterator[int]:
        for number in range(self.epoch * self.passes, (self.epoch + 1) * self.passes):
            generator = torch.Generator().manual_seed(combine_seeds(self.seed, number))
            order = torch.randperm(self.count, generator=generator)
            yield from (order + number * self.count).tolist()


class RenderedDataModule(pl.LightningDataModule):
    """Renders what to train on once, at first need, and deals it out in batches.

    Args:
        meshes: objects to train on.
        validation_meshes: other objects, for the validation loss; may be empty.
        batch_size: items in a batch.
        passes: how often each item is shown in an epoch.
        seed: of all that is random.

    Raises:
        ValueError: no meshes, no batch or no pass.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        validation_meshes: Sequence[Mesh],
        batch_size: int,
        passes: int,
        seed: int,
    ) -> None:
        super().__init__()
        if not meshes:
            raise ValueError("meshes is empty: give at least one to train on")
        if batch_size < 1 or passes < 1:
            raise ValueError(f"batch_size and passes must be at least 1, got {batch_size} and {passes}")
        self.meshes = list(meshes)
        self.validation_meshes = list(validation_meshes)
        self.batch_size = batch_size
        self.passes = passes
        self.seed = seed
        self.training: Dataset[Any] | None = None
        self.validation: Dataset[Any] | None = None

    @abstractmethod
    def render(self, validation: bool) -> Dataset[Any]:
        """The data to train on, or those for validation; a data set that makes batches itself (``__getitems__``)."""

    def setup(self, stage: str | None = None) -> None:
        """Render what is not there yet."""
        if self.training is None:
            self.training = self.render(validation=False)
        if self.validation is None and self.validation_meshes:
            self.validation = self.render(validation=True)

    def train_dataloader(self) -> DataLoader[Any]:
        """All training data in a new order each epoch.

        Raises:
            RuntimeError: :meth:`setup` has not been called; Lightning's trainer does.
        """
        if self.training is None:
            raise RuntimeError("there are no data yet: call setup() before train_dataloader()")
        sampler = EpochShuffle(len(self.training), self.seed, self.passes)  # type: ignore[arg-type]
        return DataLoader(self.training, self.batch_size, sampler=sampler, collate_fn=_as_it_is)

    def val_dataloader(self) -> list[DataLoader[Any]]:
        """All validation data, or nothing."""
        if self.validation is None:
            return []
        return [DataLoader(self.validation, self.batch_size, collate_fn=_as_it_is)]


def adam(module: nn.Module, learning_rate: float, weight_decay: float) -> torch.optim.Optimizer:
    """AdamW for what is trained, with decay for matrices only."""
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    groups = [
        {"params": [p for p in trained if p.dim() > 1], "weight_decay": weight_decay},
        {"params": [p for p in trained if p.dim() <= 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=learning_rate)


def _as_it_is(batch: Any) -> Any:
    """The data set makes batches itself."""
    return batch

"""Batches taken apart by object and put together again."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.representation.object_representation import ObjectRepresentation
from foundpose.utils.devices import indices_on

Fields = TypeVar("Fields", bound=tuple[Any, ...])
Part = TypeVar("Part", bound=Tensor | tuple[Any, ...])


class ObjectGroups:
    """Which crops of a batch show which object.

    Args:
        objects: representations.
        object_index: (B,) which object each crop shows; may be None for a single object.
        count: number B of crops.
        device: where the crops are.

    Raises:
        ValueError: ``object_index`` does not fit.
    """

    def __init__(
        self,
        objects: Sequence[ObjectRepresentation],
        object_index: Tensor | None,
        count: int,
        device: torch.device,
    ) -> None:
        if object_index is None:
            if len(objects) != 1:
                raise ValueError(f"object_index (B,) is needed to tell {len(objects)} objects apart")
            object_index = torch.zeros(count, dtype=torch.int64)
        if object_index.shape != (count,) or object_index.is_floating_point():
            raise ValueError(
                f"object_index must be ({count},) integers, got {tuple(object_index.shape)} {object_index.dtype}"
            )
        labels = object_index.cpu().long()
        if count and (int(labels.min()) < 0 or int(labels.max()) >= len(objects)):
            raise ValueError(f"object_index must lie in [0, {len(objects)}), got {labels.tolist()}")
        rows = [torch.nonzero(labels == i).flatten() for i in range(len(objects))]
        self.objects = list(objects)
        self.object_index = labels
        self._groups = [
            (obj, indices_on(device, members))
            for obj, members in zip(objects, rows, strict=True)
            if len(members) > 0
        ]
        self._back = indices_on(device, torch.cat(rows).argsort())

    def map(self, function: Callable[[ObjectRepresentation, Tensor], Part]) -> Part:
        """Call a function with each object that has crops and their indices; join what it says of them.

        Returns:
            Tensors, or a named tuple of tensors, in the order of the batch; zeros fill what is longer for another
            object.
        """
        parts = [function(obj, rows) for obj, rows in self._groups]

        def join(fields: list[Tensor]) -> Tensor:
            return torch.cat(_same_size(fields))[self._back]

        if isinstance(parts[0], Tensor):
            return cast(Part, join(cast(list[Tensor], parts)))
        return cast(Part, _combine(cast(list[tuple[Any, ...]], parts), join))


def take_rows(part: Fields, rows: Tensor) -> Fields:
    """Some rows of a named tuple of tensors."""
    return _combine([part], lambda fields: fields[0][rows])


def _combine(parts: Sequence[Fields], combine: Callable[[list[Tensor]], Tensor]) -> Fields:
    """Combine named tuples of tensors field by field; a field that is None stays None."""
    fields = [
        None if any(tensor is None for tensor in field) else combine(list(field))
        for field in zip(*parts, strict=True)
    ]
    make = cast(Callable[..., Fields], type(parts[0]))
    return make(*fields)


def _same_size(tensors: list[Tensor]) -> list[Tensor]:
    """Tensors padded with zeros to the largest size of each dimension but the first."""
    sizes = [tensor.shape[1:] for tensor in tensors]
    most = [max(size) for size in zip(*sizes, strict=True)]
    return [
        F.pad(x, [n for k, m in zip(size[::-1], most[::-1], strict=True) for n in (0, m - k)])
        if list(size) != most
        else x
        for x, size in zip(tensors, sizes, strict=True)
    ]

"""Batches taken apart by object and put together again."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

Fields = TypeVar("Fields", bound=tuple[Any, ...])


def crops_of_objects(object_index: Tensor | None, count: int, num_objects: int) -> list[Tensor]:
    """Crops of each object, as index tensors."""
    if object_index is None:
        if num_objects != 1:
            raise ValueError(f"object_index (B,) is needed to tell {num_objects} objects apart")
        return [torch.arange(count)]
    if object_index.shape != (count,) or object_index.is_floating_point():
        raise ValueError(
            f"object_index must be ({count},) integers, got {tuple(object_index.shape)} {object_index.dtype}"
        )
    labels = object_index.cpu()
    if count and (int(labels.min()) < 0 or int(labels.max()) >= num_objects):
        raise ValueError(f"object_index must lie in [0, {num_objects}), got {labels.tolist()}")
    return [torch.nonzero(labels == i).flatten() for i in range(num_objects)]


def object_of_each_crop(members: list[Tensor]) -> Tensor:
    """(B,) from the crops of each object."""
    index = torch.empty(sum(len(rows) for rows in members), dtype=torch.int64)
    for i, rows in enumerate(members):
        index[rows] = i
    return index


def take_rows(part: Fields, rows: Tensor) -> Fields:
    """Some rows of a named tuple of tensors."""
    return combine([part], lambda fields: fields[0][rows])


def combine(parts: Sequence[Fields], combine: Callable[[list[Tensor]], Tensor]) -> Fields:
    """Combine named tuples of tensors field by field; a field that is None stays None."""
    fields = [
        None if any(tensor is None for tensor in field) else combine(list(field))
        for field in zip(*parts, strict=True)
    ]
    make = cast(Callable[..., Fields], type(parts[0]))
    return make(*fields)

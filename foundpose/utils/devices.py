"""Small transfers to a device that do not wait for it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def constant(values: Sequence[Any] | Sequence[Sequence[Any]], like: Tensor) -> Tensor:
    """Numbers as a tensor of another one's type, on its device.

    ``torch.tensor(values, device="cuda")`` waits until all work before it is done.
    """
    return torch.tensor(values, dtype=like.dtype).to(like.device, non_blocking=True)


def indices_on(device: torch.device, index: Tensor) -> Tensor:
    """An index tensor on a device, without waiting where it comes from the host."""
    return index.to(device, non_blocking=index.device.type == "cpu")

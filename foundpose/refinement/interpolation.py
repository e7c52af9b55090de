"""Sampling of feature maps together with their derivatives."""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Interpolation = Literal["bilinear", "bicubic"]
_SHARPNESS = -0.5  # of the cubic kernel: Keys' value, exact on quadratic maps (torch's grid_sample has -0.75)


def sample_features(
    features: Tensor,
    map_index: Tensor,
    position: Tensor,
    interpolation: Interpolation = "bilinear",
) -> Tensor:
    """What :class:`FeatureSampler` reads at positions (n, P, 2), as (n, P, 3, d)."""
    return FeatureSampler(features, map_index, interpolation)(position).permute(1, 2, 0, 3)


class FeatureSampler:
    """Values and derivatives of feature maps at real positions; beyond the outermost cells a map continues with their
    values.

    Args:
        features: (B, h, w, d) maps, channels last; cell (row, column) lies at position (column, row).
        map_index: (n,) which map each row of positions is for, int64.
        interpolation: "bilinear", or "bicubic" (Keys' cubic convolution: its slopes are continuous).
    """

    def __init__(
        self, features: Tensor, map_index: Tensor, interpolation: Interpolation = "bilinear"
    ) -> None:
        _, h, w, d = features.shape
        self.table = features.reshape(-1, d)
        self.interpolation = interpolation
        # By columns and rows. (Made on the device: a tensor from Python numbers would wait for it.)
        last = torch.linspace(w - 1, h - 1, 2, dtype=features.dtype, device=features.device)
        self.last, self.last_first, self.last_cell = last, (last - 1).clamp(min=0), last.long().unsqueeze(-1)
        self.step = torch.linspace(1, w, 2, device=features.device).long().unsqueeze(-1)
        self.first_cell = map_index[:, None, None, None] * (h * w)

    def __call__(self, position: Tensor) -> Tensor:
        """Sample at positions (n, P, 2) as (column, row).

        Returns:
            (3, n, P, d): the value, its derivative along columns and that along rows. Differentiable w.r.t. the
            features and ``position`` (which cells are read is constant).
        """
        inside = torch.minimum(position.clamp(min=0.0), self.last)
        slope = (inside == position).to(position.dtype).unsqueeze(-1)
        first = torch.minimum(inside.detach().floor(), self.last_first)
        nearby, weight, derivative = _kernel((inside - first).unsqueeze(-1), self.interpolation)
        cells = torch.minimum((first.long().unsqueeze(-1) + nearby).clamp(min=0), self.last_cell)
        column, row = (cells * self.step).unbind(-2)
        cell = row.unsqueeze(-1) + (column.unsqueeze(-2) + self.first_cell)  # (n, P, k, k)
        (across, down), (across_slope, down_slope) = weight.unbind(-2), (derivative * slope).unbind(-2)
        vertical = torch.stack([down, down, down_slope])
        horizontal = torch.stack([across, across_slope, across])
        weights = vertical.unsqueeze(-1) * horizontal.unsqueeze(-2)  # (3, n, P, k, k)
        cell = cell.reshape(-1, cell.shape[-1] ** 2)
        weighted = bagged_rows if cell.device.type == "cpu" else gathered_rows
        return weighted(self.table, cell, weights.reshape(3, *cell.shape)).unflatten(1, position.shape[:2])


def gathered_rows(table: Tensor, cell: Tensor, weights: Tensor) -> Tensor:
    """Sums (s, n, d) of rows of a table (m, d), chosen by (n, k) and weighted by (s, n, k)."""
    # Whole rows: several times as fast as indexing by a tensor.
    rows = table.index_select(0, cell.flatten()).unflatten(0, cell.shape)
    return (weights.transpose(0, 1) @ rows).transpose(0, 1)


def bagged_rows(table: Tensor, cell: Tensor, weights: Tensor) -> Tensor:
    """:func:`gathered_rows` in one pass that writes the sums alone: a third to a seventh of the time on a CPU."""
    bags, flat = torch.cat([cell] * len(weights)), weights.flatten(0, 1)
    return F.embedding_bag(bags, table, per_sample_weights=flat, mode="sum").unflatten(0, weights.shape[:2])


def _kernel(f: Tensor, interpolation: Interpolation) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (k,) of the cells around positions that lie f (..., 1) behind a cell, their weights (..., k), and the
    derivatives of the weights, which broadcast with them."""
    if interpolation == "bilinear":
        sign = torch.linspace(-1.0, 1.0, 2, dtype=f.dtype, device=f.device)
        nearby = torch.arange(2, device=f.device)
        return nearby, torch.addcmul((1 - nearby).to(f.dtype), sign, f), sign
    near = [_cubic_near(f), _cubic_near(1.0 - f)]
    far = [_cubic_far(1.0 + f), _cubic_far(2.0 - f)]
    weight = torch.cat([far[0][0], near[0][0], near[1][0], far[1][0]], dim=-1)
    derivative = torch.cat([far[0][1], near[0][1], -near[1][1], -far[1][1]], dim=-1)
    return torch.arange(-1, 3, device=f.device), weight, derivative


def _cubic_near(x: Tensor) -> tuple[Tensor, Tensor]:
    """The cubic kernel and its derivative at distances in [0, 1]."""
    a = _SHARPNESS
    return ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0, (3.0 * (a + 2.0) * x - 2.0 * (a + 3.0)) * x


def _cubic_far(x: Tensor) -> tuple[Tensor, Tensor]:
    """The cubic kernel and its derivative at distances in [1, 2]."""
    a = _SHARPNESS
    return ((x - 5.0) * x + 8.0) * a * x - 4.0 * a, ((3.0 * x - 10.0) * x + 8.0) * a

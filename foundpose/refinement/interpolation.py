"""Sampling of feature maps together with their derivatives."""

from typing import Literal

import torch
from torch import Tensor

Interpolation = Literal["bilinear", "bicubic"]
_SHARPNESS = -0.5  # of the cubic kernel: Keys' value, exact on quadratic maps (torch's grid_sample has -0.75)


def sample_features(
    features: Tensor,
    map_index: Tensor,
    position: Tensor,
    interpolation: Interpolation = "bilinear",
    offset: Tensor | None = None,
) -> Tensor:
    """Values and derivatives of feature maps at real positions.

    Beyond the outermost cells the map continues with their values.

    Args:
        features: (B, h, w, d) maps, channels last; cell (row, column) lies at position (column, row).
        map_index: (n,) which map each row of positions is for, int64.
        position: (n, P, 2) as (column, row).
        interpolation: "bilinear", or "bicubic" (Keys' cubic convolution: its slopes are continuous).
        offset: (n, P, 3, d) added to what is returned; costs nothing.

    Returns:
        (n, P, 3, d): the value, its derivative along columns and that along rows. Differentiable w.r.t.
        ``features`` and ``position`` (which cells are read is constant).
    """
    _, h, w, d = features.shape
    if h == w:  # both axes at once, in half of the operations
        cells, weight, slope = _kernel(position, w, interpolation)
        (column, row), (across, down), (across_slope, down_slope) = (
            part.unbind(-2) for part in (cells, weight, slope)
        )
    else:
        column, across, across_slope = _kernel(position[..., 0], w, interpolation)
        row, down, down_slope = _kernel(position[..., 1], h, interpolation)
    cell = (map_index[:, None, None] * h + row).unsqueeze(-1) * w + column.unsqueeze(-2)  # (n, P, k, k)
    # Whole rows: several times as fast as indexing by a tensor.
    read = features.reshape(-1, d).index_select(0, cell.flatten()).unflatten(0, (-1, cell[0, 0].numel()))
    weights = torch.stack(
        [
            down.unsqueeze(-1) * across.unsqueeze(-2),
            down.unsqueeze(-1) * across_slope.unsqueeze(-2),
            down_slope.unsqueeze(-1) * across.unsqueeze(-2),
        ],
        dim=-3,
    )
    weights = weights.flatten(-2).flatten(0, 1)
    sampled = weights @ read if offset is None else torch.baddbmm(offset.flatten(0, 1), weights, read)
    return sampled.unflatten(0, position.shape[:2])


def _kernel(position: Tensor, size: int, interpolation: Interpolation) -> tuple[Tensor, Tensor, Tensor]:
    """Cells (..., k) around positions (...), their weights and the derivatives of the weights."""
    inside = position.clamp(0.0, size - 1.0)
    slope = (inside == position).to(position.dtype).unsqueeze(-1)
    first = inside.detach().floor().clamp(max=max(size - 2.0, 0.0))
    f = inside - first
    if interpolation == "bilinear":
        one = torch.ones_like(f)
        cells = first.long().unsqueeze(-1) + torch.arange(2, device=position.device)
        weight = torch.stack([1.0 - f, f], dim=-1)
        derivative = torch.stack([-one, one], dim=-1)
    else:
        cells = first.long().unsqueeze(-1) + torch.arange(-1, 3, device=position.device)
        near = [_cubic_near(f), _cubic_near(1.0 - f)]
        far = [_cubic_far(1.0 + f), _cubic_far(2.0 - f)]
        weight = torch.stack([far[0][0], near[0][0], near[1][0], far[1][0]], dim=-1)
        derivative = torch.stack([far[0][1], near[0][1], -near[1][1], -far[1][1]], dim=-1)
    return cells.clamp(0, size - 1), weight, derivative * slope


def _cubic_near(x: Tensor) -> tuple[Tensor, Tensor]:
    """The cubic kernel and its derivative at distances in [0, 1]."""
    a = _SHARPNESS
    return ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0, (3.0 * (a + 2.0) * x - 2.0 * (a + 3.0)) * x


def _cubic_far(x: Tensor) -> tuple[Tensor, Tensor]:
    """The cubic kernel and its derivative at distances in [1, 2]."""
    a = _SHARPNESS
    return ((x - 5.0) * x + 8.0) * a * x - 4.0 * a, ((3.0 * x - 10.0) * x + 8.0) * a

"""Smallest enclosing circles."""

from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

_PAIRS = list(combinations(range(4), 2))
_TRIPLES = list(combinations(range(4), 3))
# Each candidate circle by the places of three points; a pair repeats its second point.
_CANDIDATES = [(i, j, j) for i, j in _PAIRS] + _TRIPLES


class Circles(NamedTuple):
    """A batch of circles.

    Attributes:
        centre: (B, 2).
        radius: (B,).
        valid: (B,) False where there was no point; such a circle is zero.
    """

    centre: Tensor
    radius: Tensor
    valid: Tensor


def smallest_enclosing_circles(points: Tensor, valid: Tensor | None = None) -> Circles:
    """The smallest circle around each set of points. Exact.

    A circle is determined by two or three of its points. Starting from two that are far apart, the point farthest
    outside joins them and the smallest circle of these (at most four) takes their place, until no point is outside.
    The radius grows with every step, so it ends, as a rule after a few steps.

    Args:
        points: (B, N, 2).
        valid: (B, N) bool, which points exist; None means all. Points that are not finite do not count either.

    Raises:
        ValueError: shapes do not fit.

    Differentiable w.r.t. ``points``: through the points that determine the circle.

    Source: Gärtner, "Fast and robust smallest enclosing balls", ESA 1999 (pivoting by the farthest point).
    """
    if points.ndim != 3 or points.shape[2] != 2:
        raise ValueError(f"points must have shape (B, N, 2), got {tuple(points.shape)}")
    if valid is not None and (valid.shape != points.shape[:2] or valid.dtype != torch.bool):
        raise ValueError(
            f"valid must be bool of shape {tuple(points.shape[:2])}, got {tuple(valid.shape)} {valid.dtype}"
        )
    finite = torch.isfinite(points).all(dim=-1)
    valid = finite if valid is None else valid & finite
    found = valid.any(dim=1)
    if points.shape[1] == 0:
        return Circles(points.new_zeros(len(points), 2), points.new_zeros(len(points)), found)
    # Repeating a point changes no circle, so there is nothing to mask later on.
    first = valid.to(torch.uint8).argmax(dim=1)
    place = torch.where(valid, torch.arange(points.shape[1], device=points.device), first[:, None])
    points = torch.where(found[:, None, None], _rows(points, place), 0.0)
    # Coordinates relative to one of the points keep their digits.
    origin = points[:, :1].detach()
    local = points - origin
    support = _support(local.detach().mT.contiguous().mT)
    a, b, c = _rows(local, support).unbind(1)
    centre = _circle_centre(a, b, c)
    # No root of zero: a single point's circle has a radius of zero and a gradient of zero.
    squared = (a - centre).square().sum(dim=-1)
    radius = squared.where(squared > 0, 1.0).sqrt() * (squared > 0)
    return Circles(centre + origin[:, 0] * found[:, None], radius, found)


def _support(points: Tensor) -> Tensor:
    """Indices (B, 3) of points that determine the smallest circle around (B, N, 2); two where the last repeats."""
    far = _farthest(points, points[:, 0])[1]
    opposite = _farthest(points, _rows(points, far[:, None])[:, 0])[1]
    support = torch.stack([far, opposite, opposite], dim=1)
    centre = _circle_centre(*_rows(points, support).unbind(1))
    radius = _farthest(_rows(points, support), centre)[0]
    active = torch.ones_like(radius, dtype=torch.bool)
    candidates = torch.tensor(_CANDIDATES, device=points.device)
    while True:
        distance, outsider = _farthest(points, centre)
        active = active & (distance > radius)
        four = torch.cat([support, outsider[:, None]], dim=1)
        corners = _rows(points, four)
        a, b, c = corners[:, candidates].unbind(2)
        centres = _circle_centre(a, b, c)
        reach = torch.linalg.vector_norm(centres.unsqueeze(2) - corners.unsqueeze(1), dim=-1).amax(dim=2)
        # One of the candidates' centres is that of the smallest circle around the four, whatever the rounding. Where
        # others share it, as of two diameters that cross in the middle, the points on the circle are the outermost.
        reach = reach.nan_to_num(nan=torch.inf)
        least = reach.amin(dim=1)
        ties = reach <= least[:, None] * (1.0 + 8.0 * torch.finfo(reach.dtype).eps)
        own = torch.linalg.vector_norm(a - centres, dim=-1)
        reach, best = least, own.where(ties, -torch.inf).argmax(dim=1)
        active = active & (reach > radius)
        if not active.any():
            return support
        keep = active[:, None]
        support = torch.where(keep, four.gather(1, candidates[best]), support)
        centre = torch.where(keep, _rows(centres, best[:, None])[:, 0], centre)
        radius = torch.where(active, reach, radius)


def _farthest(points: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Distance (B,) and index (B,) of the point of (B, N, 2) that is farthest from (B, 2)."""
    # Column by column: reducing a dimension of two is slow.
    x, y = points[..., 0] - centre[:, :1], points[..., 1] - centre[:, 1:]
    squared, index = (x * x + y * y).max(dim=1)
    return squared.sqrt(), index


def _rows(points: Tensor, index: Tensor) -> Tensor:
    """Points (B, n, 2) of (B, N, 2) by indices (B, n)."""
    return points.gather(1, index.unsqueeze(-1).expand(-1, -1, 2))


def _circle_centre(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Centres (..., 2) of the circles through three points, or on the diameter ``ab`` where ``c`` equals ``b``.

    Three points on a line have a centre that is not finite.
    """
    u, v = b - a, c - a
    area = 2.0 * (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
    pair = (b == c).all(dim=-1)
    uu, vv = u.square().sum(dim=-1), v.square().sum(dim=-1)
    numerator = torch.stack([v[..., 1] * uu - u[..., 1] * vv, u[..., 0] * vv - v[..., 0] * uu], dim=-1)
    # Where it is a pair, the other branch must not divide by zero: its gradient would be no number.
    offset = numerator / area.where(~pair, 1.0).unsqueeze(-1)
    return a + torch.where(pair.unsqueeze(-1), u / 2.0, offset)

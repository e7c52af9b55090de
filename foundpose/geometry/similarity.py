"""Similarity transforms of the image plane: rotation, one scale and a shift."""

from typing import Literal, get_args

import torch
from torch import Tensor

InPlane = Literal["shift", "scale", "similarity"]

# Scales outside of these say that the matches are wrong, not that the object is so near or so far.
_SMALLEST_SCALE, _LARGEST_SCALE = 0.5, 2.0


def check_in_plane(motion: str) -> None:
    """Raise ValueError for an unknown kind of motion."""
    if motion not in get_args(InPlane):
        raise ValueError(f"alignment must be one of {get_args(InPlane)}, got {motion!r}")


def identity_similarity(like: Tensor) -> Tensor:
    """(..., 2, 3) identities for points (..., N, 2)."""
    eye = torch.eye(2, 3, dtype=like.dtype, device=like.device)
    return eye.expand(*like.shape[:-2], 2, 3)


def apply_similarity(A: Tensor, points: Tensor) -> Tensor:
    """Move points (..., N, 2) by transforms (..., 2, 3). Differentiable w.r.t. both."""
    return points @ A[..., :2].transpose(-1, -2) + A[..., None, :, 2]


def fit_similarity(source: Tensor, target: Tensor, weight: Tensor, motion: InPlane = "similarity") -> Tensor:
    """Transforms that bring points closest to others, by weighted least squares.

    Args:
        source: (..., N, 2).
        target: (..., N, 2).
        weight: (..., N), not negative.
        motion: what may change: the "shift" alone, the "scale" too, or the rotation too ("similarity").

    Returns:
        (..., 2, 3) with ``target ≈ A[:, :2] source + A[:, 2]``; the scale stays between a half and two. Where no
        weight is left, or only one point has any, nothing is turned or scaled.

    Differentiable w.r.t. all tensors.
    Source: Umeyama, "Least-squares estimation of transformation parameters", 1991, in the plane.
    """
    return _fit(_rows(source), _rows(target), weight, motion)


def fit_similarity_robustly(
    source: Tensor,
    target: Tensor,
    weight: Tensor,
    scales: tuple[float, ...],
    motion: InPlane = "similarity",
    start: Tensor | None = None,
) -> Tensor:
    """As :func:`fit_similarity` with wrong pairs among the right ones: reweighted by Cauchy's loss, ever more
    narrowly.

    Args:
        source: (..., N, 2).
        target: (..., N, 2).
        weight: (..., N), not negative.
        scales: distance at which a pair counts a half, one for each fit.
        motion: what may change.
        start: (..., 2, 3) where to start; None: the identity.

    Differentiable w.r.t. all tensors.
    """
    A = identity_similarity(source) if start is None else start
    source, target = _rows(source), _rows(target)
    for scale in scales:
        squared = (A[..., :2] @ source + A[..., 2:] - target).square().sum(dim=-2)
        A = _fit(source, target, weight / (1.0 + squared / scale**2), motion)
    return A


def _rows(points: Tensor) -> Tensor:
    """Points (..., N, 2) as (..., 2, N)."""
    return points.transpose(-1, -2).contiguous()


def _fit(source: Tensor, target: Tensor, weight: Tensor, motion: InPlane) -> Tensor:
    """:func:`fit_similarity` of points (..., 2, N): sums run along memory."""
    share = weight / weight.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    share = share.unsqueeze(-2)
    from_mean, to_mean = ((share * points).sum(dim=-1, keepdim=True) for points in (source, target))
    x, y = source - from_mean, target - to_mean
    weighted = share * x
    spread = (weighted * x).sum(dim=(-2, -1))
    cosine = (weighted * y).sum(dim=(-2, -1))
    sine = (weighted[..., 0, :] * y[..., 1, :] - weighted[..., 1, :] * y[..., 0, :]).sum(dim=-1)
    if motion != "similarity":
        sine = torch.zeros_like(sine)
    known = (spread > 0) & (cosine.square() + sine.square() > 0)
    spread = spread.where(known, torch.ones_like(spread))
    cosine = torch.where(known, cosine / spread, torch.ones_like(cosine))
    sine = torch.where(known, sine / spread, torch.zeros_like(sine))
    scale = torch.sqrt(cosine.square() + sine.square())
    factor = scale.clamp(_SMALLEST_SCALE, _LARGEST_SCALE) / scale
    if motion == "shift":
        cosine, factor = torch.ones_like(cosine), torch.ones_like(factor)
    a, b = cosine * factor, sine * factor
    linear = torch.stack([torch.stack([a, -b], dim=-1), torch.stack([b, a], dim=-1)], dim=-2)
    return torch.cat([linear, to_mean - linear @ from_mean], dim=-1)

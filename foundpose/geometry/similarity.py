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
    share = weight / weight.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    from_mean = (share.unsqueeze(-1) * source).sum(dim=-2)
    to_mean = (share.unsqueeze(-1) * target).sum(dim=-2)
    x, y = source - from_mean.unsqueeze(-2), target - to_mean.unsqueeze(-2)
    spread = (share * x.square().sum(dim=-1)).sum(dim=-1)
    cosine = (share * (x * y).sum(dim=-1)).sum(dim=-1)
    sine = (share * (x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0])).sum(dim=-1)
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
    shift = to_mean - (linear @ from_mean.unsqueeze(-1)).squeeze(-1)
    return torch.cat([linear, shift.unsqueeze(-1)], dim=-1)


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
    for scale in scales:
        squared = (apply_similarity(A, source) - target).square().sum(dim=-1)
        A = fit_similarity(source, target, weight / (1.0 + squared / scale**2), motion)
    return A

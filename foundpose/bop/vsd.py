"""Visible Surface Discrepancy: how well an estimate's visible surface agrees with the truth's in a depth image."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

BOP_DELTA = 15.0
"""How far behind the measured surface, in millimetres, a rendered one still counts as visible (BOP'19)."""


class VisibleSurfaces(NamedTuple):
    """Where a pair of rendered objects is visible.

    Attributes:
        estimate: (B, H, W) bool.
        true: (B, H, W) bool.
    """

    estimate: Tensor
    true: Tensor


def distance_images(depth: Tensor, K: Tensor) -> Tensor:
    """Distances from the camera's centre instead of depths along its axis.

    As in BOP's toolkit, the ray of pixel (u, v) passes through its integer coordinates, wherever in the pixel the
    depth was sampled.

    Args:
        depth: (B, H, W).
        K: (B, 3, 3) or (1, 3, 3) intrinsics of the images, pixels; skew plays no part.

    Returns:
        (B, H, W), 0 where the depth is 0. Differentiable w.r.t. both.
    """
    height, width = depth.shape[-2:]
    K = K.to(depth)
    u = torch.arange(width, device=depth.device, dtype=depth.dtype)
    v = torch.arange(height, device=depth.device, dtype=depth.dtype)
    x = (u - K[:, 0, 2, None]) / K[:, 0, 0, None]
    y = (v - K[:, 1, 2, None]) / K[:, 1, 1, None]
    return depth * (x.square()[:, None, :] + y.square()[:, :, None] + 1.0).sqrt()


def visible_surfaces(
    distance_est: Tensor, distance_true: Tensor, distance_test: Tensor, delta: float = BOP_DELTA
) -> VisibleSurfaces:
    """Which pixels of a rendered object the camera saw, by the rules of BOP'19.

    A rendered pixel is visible if its surface lies at most ``delta`` behind the measured one, or where nothing was
    measured. The estimate is visible moreover wherever the truth is.

    Args:
        distance_est: (B, H, W) rendered with the estimated poses, 0 off the object.
        distance_true: (B, H, W) rendered with the true poses.
        distance_test: (B, H, W) or (1, H, W) measured, 0 without measurement.
        delta: tolerance in the images' unit.
    """
    unknown = distance_test == 0
    true = (distance_true > 0) & ((distance_true - distance_test <= delta) | unknown)
    estimate = (distance_est > 0) & ((distance_est - distance_test <= delta) | unknown | true)
    return VisibleSurfaces(estimate, true)


def vsd(
    depth_est: Tensor,
    depth_true: Tensor,
    depth_test: Tensor,
    K: Tensor,
    taus: Sequence[float],
    diameter: Tensor | float,
    delta: float = BOP_DELTA,
) -> Tensor:
    """Visible Surface Discrepancy with the step cost of BOP'19.

    The share of the pixels where either surface is visible that are visible in one only or where the two lie at
    least ``tau`` diameters apart. Images may be cut to any window that holds both objects, with ``K`` shifted
    accordingly, and padded with zeros on the right and at the bottom: the value stays the same.

    Args:
        depth_est: (B, H, W) z of the object in its estimated poses, 0 off the object.
        depth_true: (B, H, W) z of the object in its true poses.
        depth_test: (B, H, W) or (1, H, W) the measured depth image, 0 without measurement.
        K: (B, 3, 3) or (1, 3, 3) intrinsics, pixels.
        taus: misalignment tolerances, shares of the diameter.
        diameter: (B,) or a number; of the objects, in the unit of the depths.
        delta: visibility tolerance in the unit of the depths.

    Returns:
        (B, len(taus)) in [0, 1], dtype of ``depth_est``; 1 where no pixel of either is visible.

    Raises:
        ValueError: wrong shapes or dtypes.

    Differentiable w.r.t. nothing: it counts pixels.
    Source: Hodaň et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; visibility as in BOP'19.
    """
    _check_inputs(depth_est, depth_true, depth_test, K)
    distance_est, distance_true, distance_test = (
        distance_images(depth.detach(), K) for depth in (depth_est, depth_true, depth_test)
    )
    visible = visible_surfaces(distance_est, distance_true, distance_test, delta)
    both, either = visible.estimate & visible.true, visible.estimate | visible.true
    diameter = torch.as_tensor(diameter, dtype=depth_est.dtype, device=depth_est.device).reshape(-1, 1, 1)
    apart = (distance_est - distance_true).abs() / diameter
    one_only = (either & ~both).sum((1, 2))
    apart_by = torch.stack([(both & (apart >= tau)).sum((1, 2)) for tau in taus], dim=1)
    union = either.sum((1, 2))[:, None]
    share = (apart_by + one_only[:, None]).to(depth_est.dtype) / union.clamp(min=1).to(depth_est.dtype)
    return torch.where(union > 0, share, torch.ones_like(share))


def _check_inputs(depth_est: Tensor, depth_true: Tensor, depth_test: Tensor, K: Tensor) -> None:
    if depth_est.dim() != 3 or depth_true.shape != depth_est.shape:
        raise ValueError(
            "depth_est and depth_true must both have shape (B, H, W), got "
            f"{tuple(depth_est.shape)} and {tuple(depth_true.shape)}"
        )
    batch, *size = depth_est.shape
    if depth_test.shape not in [(batch, *size), (1, *size)]:
        raise ValueError(
            f"depth_test must have shape {(batch, *size)} or {(1, *size)}, got {tuple(depth_test.shape)}"
        )
    if K.shape not in [(batch, 3, 3), (1, 3, 3)]:
        raise ValueError(f"K must have shape ({batch}, 3, 3) or (1, 3, 3), got {tuple(K.shape)}")
    if not depth_est.is_floating_point() or {depth_true.dtype, depth_test.dtype} != {depth_est.dtype}:
        raise ValueError(
            "the depth images must share a floating dtype, got "
            f"{depth_est.dtype}, {depth_true.dtype} and {depth_test.dtype}"
        )

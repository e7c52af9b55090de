"""Distance between the projections of the model's points under the estimated and the true pose."""

import torch
from torch import Tensor

from foundpose.geometry.symmetries import Symmetries
from foundpose.losses.alignment import nearest_truth
from foundpose.losses.reduction import (
    Norm,
    PoseLoss,
    Reduction,
    check_choice,
    check_like,
    check_points,
    check_poses,
    keep_valid,
    mean_norm,
    place_points,
)

# Share of a point's true depth below which its projection is continued.
_NEAR = 0.1
# Cosine to the optical axis below which a true point counts as out of any view.
_GRAZING = 0.01


def projection_error(
    T_est: Tensor,
    T_true: Tensor,
    points_model: Tensor,
    K: Tensor,
    symmetries: Symmetries | None = None,
    valid: Tensor | None = None,
    norm: Norm = "l1",
) -> Tensor:
    """Mean distance in pixels between projected model points, the least over the object's symmetries.

    A point projects at ``K (x / z, y / z, 1)`` while its depth is above a tenth of its true depth. Below that,
    also behind the camera, 1 / z goes on along its tangent: an estimate whose points come too near or go behind
    the camera has a finite error that keeps growing with a slope that points back, where the true projection
    would jump to infinity and come back from the other side. True points more than 89° off the optical axis, or
    behind the camera, are given no meaning but stay finite; equal poses have error 0 everywhere.

    Angles of continuous symmetries are searched for as in :func:`point_matching_error`, for every norm (with "l1",
    3 of 1000 random poses of a cylinder ended above the minimum, the worst by 3 %).

    Args:
        T_est: (B, 4, 4) estimated ``T_camera_from_model``.
        T_true: (B, 4, 4) true ``T_camera_from_model``, the object in front of the camera.
        points_model: (B, M, 3) or (M, 3), mesh units.
        K: (B, 3, 3) intrinsics, pixels.
        symmetries: :class:`Symmetries` of the B objects; None for none.
        valid: (B,) bool; the error of a sample that is not valid is 0, with zero gradient, whatever it holds.
        norm: of a displacement: "l1" (sum of the absolute coordinates), "l2" or "squared" (l2, squared).

    Returns:
        (B,) errors in pixels (squared for "squared").

    Raises:
        ValueError: shapes, dtypes or devices disagree, or the norm is unknown.

    Differentiable w.r.t. ``T_est``, ``T_true``, ``points_model``, ``K`` and the symmetries' transforms, axes and
    origins, wherever the best symmetry is unique; its choice counts as a constant.
    """
    check_choice("norm", norm, Norm)
    check_poses(T_est, T_true, valid)
    points = check_points(points_model, T_est)
    if K.shape != (len(T_est), 3, 3):
        raise ValueError(f"K must have shape ({len(T_est)}, 3, 3), one for each pose, got {tuple(K.shape)}")
    check_like("K", K, T_est)
    eye = torch.eye(4, dtype=T_est.dtype, device=T_est.device)
    T_est, T_true = keep_valid(valid, T_est, eye), keep_valid(valid, T_true, eye)
    points = keep_valid(valid, points, torch.ones_like(points[:1]))
    K = keep_valid(valid, K, eye[:3, :3])
    if symmetries is not None:
        a, x, k = T_est.detach()[:, None], points.detach(), K.detach()
        nearest = nearest_truth(
            lambda T: _distance(a, T, x, k, norm), T_est, T_true, symmetries, points, refine=True
        )
        T_true = keep_valid(valid, nearest, eye)
    errors = _distance(T_est[:, None], T_true[:, None], points, K, norm).squeeze(1)
    return keep_valid(valid, errors, torch.zeros_like(errors))


def _distance(T_est: Tensor, T_true: Tensor, points: Tensor, K: Tensor, norm: Norm) -> Tensor:
    """Errors (B, N) of poses (B, 1, 4, 4) against (B, N, 4, 4)."""
    estimated, true = place_points(T_est, points), place_points(T_true, points)
    x, y, z = true.unbind(-2)
    # Not vector_norm, which is slow here; the clamp keeps the derivative finite for a point in the camera itself.
    distance = (x * x + y * y + z * z).clamp(min=torch.finfo(z.dtype).tiny).sqrt()
    nearest = torch.maximum(_NEAR * z, _GRAZING * distance).clamp(min=torch.finfo(z.dtype).eps)
    # The principal point cancels.
    displacements = K[:, None, :2, :2] @ (_slopes(estimated, nearest) - _slopes(true, nearest))
    return mean_norm(displacements, norm)


def _slopes(points: Tensor, nearest: Tensor) -> Tensor:
    """``(x / z, y / z)`` (..., 2, M) of points (..., 3, M); 1 / z goes on along its tangent below ``nearest``."""
    depth = points[..., 2, :]
    beyond = (2.0 - depth.clamp(max=nearest) / nearest) / nearest
    inverse = torch.where(depth > nearest, 1.0 / torch.maximum(depth, nearest), beyond)
    return points[..., :2, :] * inverse.unsqueeze(-2)


class ProjectionLoss(PoseLoss):
    """Mean distance in pixels between projected model points; see :func:`projection_error`.

    Args:
        norm: "l1", "l2" or "squared".
        reduction: "none" for (B,), "mean" over the valid samples or "sum".
    """

    def __init__(self, norm: Norm = "l1", reduction: Reduction = "none") -> None:
        super().__init__(reduction, norm)

    def forward(
        self,
        T_est: Tensor,
        T_true: Tensor,
        points_model: Tensor,
        K: Tensor,
        symmetries: Symmetries | None = None,
        valid: Tensor | None = None,
    ) -> Tensor:
        """Loss (B,), or () if reduced; arguments as for :func:`projection_error`.

        Differentiable w.r.t. the same.
        """
        errors = projection_error(T_est, T_true, points_model, K, symmetries, valid, self.norm)
        return self.reduce(errors, valid)

"""The pose update that learned refiners predict: image shift, relative depth and rotation, disentangled."""

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.geometry import make_transform

UPDATE_SIZE = 9
"""Numbers of an update: ``(vx, vy, vz)`` and the first two columns of a rotation."""

IDENTITY_UPDATE = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""The update that leaves a pose as it is."""

# Columns whose angle is less than this, in radians, span no plane: what is left of one would be rounding noise.
_PARALLEL = 1e-3


def rotation_from_6d(columns: Tensor) -> Tensor:
    """Rotations from two columns each, made orthonormal by Gram and Schmidt: (..., 6) → (..., 3, 3).

    Columns that are zero or parallel give a matrix that is no rotation (its determinant is about 0).

    Differentiable w.r.t. ``columns``, except where they are zero or parallel.

    Source: Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019.
    """
    a, b = columns.split(3, dim=-1)
    x = F.normalize(a, dim=-1)
    b = F.normalize(b, dim=-1)
    y = F.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1, eps=_PARALLEL)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-1)], dim=-1)


def rotation_to_6d(R: Tensor) -> Tensor:
    """The first two columns of rotations: (..., 3, 3) → (..., 6). Differentiable w.r.t. ``R``."""
    return R[..., :2].transpose(-1, -2).flatten(-2)


def apply_update(T_view_from_model: Tensor, update: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """Move poses by predicted updates.

    The object's centre at (x, y, z) goes to ``z' = vz z``, ``x' = (vx / fx + x / z) z'`` and y' alike, so ``vx`` and
    ``vy`` are pixels, ``vz`` is the ratio of depths, and neither knows of the object's size or distance. The
    object turns about its centre, ``R' = R(6D) R``, so turning it does not move it.

    Args:
        T_view_from_model: (..., 4, 4), mesh units.
        update: (..., 9) as ``(vx, vy, vz, 6D)``; see :func:`rotation_from_6d`.
        K: (..., 3, 3) intrinsics of the view in pixels, without skew.
        centre: (..., 3) centre of the object in the model frame.

    Returns:
        (..., 4, 4) poses. Differentiable w.r.t. all arguments.

    Source: Li et al., "DeepIM", ECCV 2018; Labbé et al., "CosyPose", ECCV 2020.
    """
    R = T_view_from_model[..., :3, :3]
    x = _centre_in_view(T_view_from_model, centre)
    depth = update[..., 2:3] * x[..., 2:]
    focal = K[..., [0, 1], [0, 1]]
    lateral = (update[..., :2] / focal + x[..., :2] / x[..., 2:]) * depth
    R_new = rotation_from_6d(update[..., 3:9]) @ R
    moved = torch.cat([lateral, depth], dim=-1)
    return make_transform(R_new, moved - (R_new @ centre.unsqueeze(-1)).squeeze(-1))


def update_between(T_from: Tensor, T_to: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """The update that takes one pose to another: the inverse of :func:`apply_update`.

    Args:
        T_from: (..., 4, 4) ``T_view_from_model`` before.
        T_to: (..., 4, 4) ``T_view_from_model`` after; the object's centre lies in front of the camera in both.
        K: (..., 3, 3) intrinsics of the view in pixels, without skew.
        centre: (..., 3) centre of the object in the model frame.

    Returns:
        (..., 9). Differentiable w.r.t. all arguments.
    """
    a, b = _centre_in_view(T_from, centre), _centre_in_view(T_to, centre)
    focal = K[..., [0, 1], [0, 1]]
    shift = focal * (b[..., :2] / b[..., 2:] - a[..., :2] / a[..., 2:])
    turn = T_to[..., :3, :3] @ T_from[..., :3, :3].transpose(-1, -2)
    return torch.cat([shift, b[..., 2:] / a[..., 2:], rotation_to_6d(turn)], dim=-1)


def _centre_in_view(T: Tensor, centre: Tensor) -> Tensor:
    return (T[..., :3, :3] @ centre.unsqueeze(-1)).squeeze(-1) + T[..., :3, 3]

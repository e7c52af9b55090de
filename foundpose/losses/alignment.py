"""The symmetry under which the ground truth comes nearest to an estimate."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from foundpose.geometry.symmetries import Symmetries, axis_rotation, nearest_axis_angles

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_COARSE = 8


def best_symmetry(
    error: Callable[[Tensor], Tensor], symmetries: Symmetries, angles: Tensor, refine: bool
) -> Tensor:
    """Symmetry of the smallest error, for each sample.

    The choice is made on constants; what is returned is differentiable for that choice. By the envelope theorem
    the gradient of the error at the best symmetry is that of the smallest error, wherever the choice is unique.

    Args:
        error: maps symmetries (B, N, 4, 4) to errors (B, N), all constants.
        symmetries: :class:`Symmetries` of B objects.
        angles: (B, S, A) angle about each axis after each discrete symmetry, in radians.
        refine: whether the angles are only where to start and the best ones are to be searched for.

    Returns:
        ``T_model_from_model`` (B, 4, 4). Differentiable w.r.t. the symmetries, not the angles.
    """
    constant, angles = symmetries.detach(), angles.detach()
    batch, _, num_axes = angles.shape
    errors = error(constant.transforms).masked_fill(~symmetries.valid, torch.inf)[..., None]
    if num_axes > 0:

        def turned(angles: Tensor) -> Tensor:
            C = axis_rotation(constant.axes[:, None], constant.origins[:, None], angles)
            return error((C @ constant.transforms[:, :, None]).flatten(1, 2)).view_as(angles)

        if refine:
            angles = search_angles(turned, angles)
        exists = symmetries.valid[:, :, None] & symmetries.axis_valid[:, None]
        errors = torch.cat([errors, turned(angles).masked_fill(~exists, torch.inf)], dim=-1)
    best = errors.flatten(1).argmin(dim=1)
    sample = torch.arange(batch, device=best.device)
    D = symmetries.transforms[sample, best // (1 + num_axes)]
    if num_axes == 0:
        return D
    # A discrete symmetry alone is the angle 0 about any axis.
    angle = torch.cat([torch.zeros_like(angles[..., :1]), angles], dim=-1).flatten(1)[sample, best]
    axis = (best % (1 + num_axes) - 1).clamp(min=0)
    return axis_rotation(symmetries.axes[sample, axis], symmetries.origins[sample, axis], angle) @ D


def nearest_truth(
    error: Callable[[Tensor], Tensor],
    T_est: Tensor,
    T_true: Tensor,
    symmetries: Symmetries,
    points: Tensor,
    refine: bool = False,
) -> Tensor:
    """The equivalent true pose (B, 4, 4) of the smallest error; see :func:`best_symmetry`.

    Args:
        error: maps true poses (B, N, 4, 4) to errors (B, N), all constants.
        T_est: (B, 4, 4) estimated poses.
        T_true: (B, 4, 4) true poses.
        symmetries: :class:`Symmetries` of B objects.
        points: (B, M, 3) or (1, M, 3) of the models; angles are of least mean squared distance of these.
        refine: whether that is only where to start.

    Raises:
        ValueError: the symmetries do not fit the poses.
    """
    symmetries.check(len(T_est), T_est)
    a, b, x = T_est.detach(), T_true.detach(), points.detach()
    mean = x.mean(dim=1)
    centred = x - mean[:, None]
    covariance = centred.mT @ centred / x.shape[1]
    angles = nearest_axis_angles(a, b, symmetries.detach(), mean, covariance)
    return T_true @ best_symmetry(lambda S: error(b[:, None] @ S), symmetries, angles, refine)


def search_angles(error: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """Minimise errors over angles, one by one and all at once.

    Samples the circle at eight angles, ``start`` among them, then narrows the surroundings of the best one by
    golden section to the square root of the rounding unit, beyond which the error is flat. That is the minimum
    where the circle has one valley.

    Args:
        error: maps angles of any shape to errors of that shape, each of its angle alone.
        start: angles in radians.

    Returns:
        Angles of ``start``'s shape whose errors are not above those at ``start``. Not differentiable.
    """
    spacing = 2.0 * math.pi / _COARSE
    best, lowest = start, error(start)
    for k in range(1, _COARSE):
        angle = start + k * spacing
        value = error(angle)
        best, lowest = torch.where(value < lowest, angle, best), torch.minimum(value, lowest)
    low, high = best - spacing, best + spacing
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    error_left, error_right = error(left), error(right)
    precision = math.sqrt(torch.finfo(start.dtype).eps)
    for _ in range(math.ceil(math.log(precision / (2.0 * spacing)) / math.log(_GOLDEN))):
        go_left = error_left < error_right
        low, high = torch.where(go_left, low, left), torch.where(go_left, right, high)
        angle = torch.where(go_left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        value = error(angle)
        left, right = torch.where(go_left, angle, right), torch.where(go_left, left, angle)
        error_left, error_right = (
            torch.where(go_left, value, error_right),
            torch.where(go_left, error_left, value),
        )
    found = torch.where(error_left < error_right, left, right)
    return torch.where(torch.minimum(error_left, error_right) < lowest, found, best)

"""Poses by SciPy's general least-squares solver, with derivatives by finite differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry import make_transform
from foundpose.optimization import BarronLoss
from foundpose.refinement import AlignmentProblem, FeaturemetricAlignment

Array = NDArray[Any]

UNSUPPORTED = (
    "the SciPy reference knows Barron's loss (alpha < 0) on each channel of raw descriptors with bilinear "
    "interpolation only"
)
"""Why some settings of the refinement have no reference."""


def turned(T: Tensor, points_model: Tensor, degrees: float) -> Tensor:
    """Poses (B, 4, 4) turned about the centroid of points (N, 3), by some degrees about the axis (1, 1, 1)."""
    axis = np.deg2rad(degrees) * np.ones(3) / np.sqrt(3.0)
    R = torch.from_numpy(Rotation.from_rotvec(axis).as_matrix()).to(T)
    centroid = points_model.mean(0)
    centre = T[:, :3, :3] @ centroid + T[:, :3, 3]
    R = R @ T[:, :3, :3]
    return make_transform(R, centre - R @ centroid)


def pnp_least_squares(T: Array, points_model: Array, points_image: Array, K: Array) -> Tensor:
    """Least squares of the reprojection error by Levenberg-Marquardt (MINPACK).

    Args:
        T: (4, 4) initial pose.
        points_model: (N, 3).
        points_image: (N, 2) pixels.
        K: (3, 3).
    """
    camera, pose = _local_frame(T, points_model)

    def residuals(parameters: Array) -> Array:
        y = camera(parameters) @ K.T
        return (y[:, :2] / y[:, 2:] - points_image).ravel()

    return pose(least_squares(residuals, np.zeros(6), method="lm").x)


def featuremetric_least_squares(
    T: Tensor, problem: AlignmentProblem, alignment: FeaturemetricAlignment
) -> Tensor:
    """What :class:`FeaturemetricAlignment` minimises, by SciPy's trust-region method with the same robust loss.

    Args:
        T: (4, 4) initial pose.
        problem: of one pose.
        alignment: its loss and number of iterations are used.

    Raises:
        ValueError: settings other than Barron's loss on each channel with bilinear interpolation.
    """
    loss = alignment.loss
    if not is_supported(alignment) or not isinstance(loss, BarronLoss):
        raise ValueError(UNSUPPORTED)
    alpha, scale = float(loss.alpha), float(loss.scale)
    valid = problem.valid[0].cpu().numpy()
    features = problem.maps.values[0].double().cpu().numpy()
    descriptors = problem.descriptors[0].double().cpu().numpy()[valid]
    points_model = problem.points_model[0].double().cpu().numpy()[valid]
    K = problem.K[0].double().cpu().numpy()
    camera, pose = _local_frame(T.double().cpu().numpy(), points_model)

    def residuals(parameters: Array) -> Array:
        y = camera(parameters) @ K.T
        pixels = y[:, :2] / y[:, 2:]
        sampled = _bilinear(features, (pixels - problem.maps.grid.offset) / problem.maps.grid.stride)
        outside = (pixels < -0.5) | (pixels > problem.maps.image_size - 0.5)
        # A patch out of sight counts about the ceiling, as in ours.
        lost = outside.any(1) | (y[:, 2] <= 0)
        return np.where(lost[:, None], 1e3 * scale, sampled - descriptors).ravel()

    def rho(z: Array) -> Array:
        base = z / abs(alpha - 2.0) + 1.0
        return np.stack(
            [
                2.0 * abs(alpha - 2.0) / alpha * (base ** (alpha / 2.0) - 1.0),
                base ** (alpha / 2.0 - 1.0),
                (alpha / 2.0 - 1.0) / abs(alpha - 2.0) * base ** (alpha / 2.0 - 2.0),
            ]
        )

    found = least_squares(
        residuals, np.zeros(6), loss=rho, f_scale=scale, max_nfev=alignment.max_iterations, ftol=1e-5
    )
    return pose(found.x)


def is_supported(alignment: FeaturemetricAlignment) -> bool:
    """Whether :func:`featuremetric_least_squares` knows an alignment's settings."""
    return (
        isinstance(alignment.loss, BarronLoss)
        and float(alignment.loss.alpha) < 0
        and alignment.residual == "channel"
        and alignment.interpolation == "bilinear"
        and not alignment.normalize
        and not alignment.auto_scale
    )


def _local_frame(T: Array, points_model: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Tensor]]:
    """Points in the camera's frame, and the pose, as functions of a turn about the centroid and a shift in units
    of the object's size."""
    centroid = points_model.mean(0)
    turned_points = (points_model - centroid) @ T[:3, :3].T
    origin = T[:3, :3] @ centroid + T[:3, 3]
    size = float(np.sqrt((turned_points**2).sum(1).mean()))

    def camera(parameters: Array) -> Array:
        R = Rotation.from_rotvec(parameters[:3]).as_matrix()
        return np.asarray(turned_points @ R.T + origin + size * parameters[3:])

    def pose(parameters: Array) -> Tensor:
        R = Rotation.from_rotvec(parameters[:3]).as_matrix() @ T[:3, :3]
        result = np.eye(4)
        result[:3, :3] = R
        result[:3, 3] = origin + size * parameters[3:] - R @ centroid
        return torch.from_numpy(result)

    return camera, pose


def _bilinear(features: Array, position: Array) -> Array:
    """Values (N, d) of a map (h, w, d) at positions (N, 2) as (column, row), clamped to the outermost cells."""
    h, w, _ = features.shape
    position = np.clip(position, 0.0, [w - 1.0, h - 1.0])
    column, row = np.minimum(position.astype(np.int64), [w - 2, h - 2]).T
    x, y = (position - np.stack([column, row], axis=1)).T[:, :, None]
    top = (1.0 - x) * features[row, column] + x * features[row, column + 1]
    bottom = (1.0 - x) * features[row + 1, column] + x * features[row + 1, column + 1]
    return np.asarray((1.0 - y) * top + y * bottom)

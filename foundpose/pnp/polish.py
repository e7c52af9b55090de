"""Polish of poses by minimising the reprojection error."""

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points
from foundpose.optimization.levenberg_marquardt import (
    LevenbergMarquardtResult,
    NormalEquations,
    levenberg_marquardt,
)
from foundpose.optimization.robust import RobustLoss


def polish_pnp(
    T_camera_from_model: Tensor,
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    weights: Tensor | None = None,
    *,
    loss: RobustLoss | None = None,
    max_iterations: int = 10,
) -> LevenbergMarquardtResult:
    """Minimise ``½ Σ w ρ(‖π(K, T x) − u‖²)`` over the pose, one problem per batch element.

    The optimisation runs in a frame at the object's centroid in units of the object's size, where rotation and
    translation hardly couple: in the camera frame a narrow field of view leaves float32 few digits.

    Args:
        T_camera_from_model: (B, 4, 4) initial poses with every weighted point in front of the camera.
        points_image: (B, N, 2) pixels.
        points_model: (B, N, 3) mesh units.
        K: (B, 3, 3) intrinsics.
        weights: (B, N) non-negative; a bool mask works too. None means all ones. Points of weight zero must
            be finite but are ignored.
        loss: ρ on squared pixel distances; None means least squares.
        max_iterations: Levenberg-Marquardt iterations.

    Returns:
        A :class:`~foundpose.optimization.LevenbergMarquardtResult`; its costs are in px². A sample whose
        initial pose has a weighted point behind the camera, or that has no weighted point, comes back as it
        was with ``failed`` set. ``H`` belongs to twists in the frame that the optimisation runs in.

    Raises:
        ValueError: shapes do not fit.

    Differentiable w.r.t. all tensors, through the steps taken (unrolled).

    Source: paper, section "Pose estimation from 2D-3D correspondences".
    """
    check_correspondences(points_image, points_model, K, weights)
    if weights is None:
        weights = torch.ones_like(points_image[..., 0])
    weights = weights.to(points_image.dtype)

    total = weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    centroid = (weights.unsqueeze(-1) * points_model).sum(-2) / total
    centred = points_model - centroid.unsqueeze(-2)
    # Root mean square distance from the centroid; its value only scales the problem, so it has no gradient.
    variance = (weights * centred.square().sum(-1)).sum(-1, keepdim=True).detach() / total.detach()
    size = torch.where(variance > 0, variance, torch.ones_like(variance)).sqrt()
    points_local = centred / size.unsqueeze(-1)
    # x_camera = origin + size * (T_local @ x_local), with T_local a pure rotation at the start.
    R = T_camera_from_model[:, :3, :3]
    origin = transform_points(T_camera_from_model, centroid.unsqueeze(-2)).squeeze(-2)

    def evaluate(T_local: Tensor) -> NormalEquations:
        return reprojection_equations(
            T_local, points_local, points_image, K, weights, origin=origin, size=size, loss=loss
        )

    # Pixel coordinates carry rounding errors of a few units in their last place.
    rounding = 8.0 * torch.finfo(points_image.dtype).eps * K.detach().abs().amax((-1, -2))
    result = levenberg_marquardt(
        evaluate,
        make_transform(R, torch.zeros_like(origin)),
        max_iterations=max_iterations,
        floor=weights.detach().sum(-1) * rounding.square(),
    )
    R = result.T[:, :3, :3]
    t = origin + size * result.T[:, :3, 3] - (R @ centroid.unsqueeze(-1)).squeeze(-1)
    return result._replace(T=make_transform(R, t))


def reprojection_equations(
    T_local: Tensor,
    points_local: Tensor,
    points_image: Tensor,
    K: Tensor,
    weights: Tensor,
    *,
    origin: Tensor,
    size: Tensor,
    loss: RobustLoss | None = None,
) -> NormalEquations:
    """Linearise the reprojection error of ``origin + size * (T_local @ points_local)``.

    Args:
        T_local: (B, 4, 4).
        points_local: (B, N, 3).
        points_image: (B, N, 2) pixels.
        K: (B, 3, 3) intrinsics.
        weights: (B, N).
        origin: (B, 3) origin of the local frame in the camera frame, mesh units.
        size: (B, 1) mesh units per unit of the local frame.
        loss: ρ on squared pixel distances; None means least squares.

    Returns:
        The normal equations of ``T_local ← exp(δ) @ T_local``; the cost is infinite where a weighted point
        lies behind the camera. Differentiable w.r.t. all tensors.
    """
    rotated = transform_points(T_local, points_local)
    points_camera = origin.unsqueeze(-2) + size.unsqueeze(-1) * rotated
    x, y, depth = points_camera.unbind(-1)
    in_front = depth > 0
    inverse = 1.0 / torch.where(in_front, depth, torch.ones_like(depth))
    plane = torch.stack([x * inverse, y * inverse], dim=-1)
    focal = K[:, None, :2, :2]
    residual = (focal @ plane.unsqueeze(-1)).squeeze(-1) + K[:, None, :2, 2] - points_image
    squared = residual.square().sum(-1)
    rho, slope = (squared, torch.ones_like(squared)) if loss is None else loss(squared)
    used = weights > 0
    # Points out of use may lie anywhere, also where their residual overflows.
    cost = 0.5 * torch.where(used, weights * rho, torch.zeros_like(rho)).sum(-1)
    cost = cost.masked_fill((used & ~in_front).any(-1), torch.inf)

    # d plane / d points_camera, then d points_camera / d δ = size [I, −[rotated]×].
    zero = torch.zeros_like(inverse)
    columns = [inverse, zero, -plane[..., 0] * inverse, zero, inverse, -plane[..., 1] * inverse]
    by_point = focal @ torch.stack(columns, dim=-1).unflatten(-1, (2, 3)) * size[..., None, None]
    by_rotation = torch.linalg.cross(rotated.unsqueeze(-2).expand_as(by_point), by_point, dim=-1)
    J = torch.cat([by_point, by_rotation], dim=-1)
    share = torch.where(used & in_front, weights * slope, zero)
    J_weighted = (J * share[..., None, None]).flatten(1, 2)
    J = J.flatten(1, 2)
    H = J_weighted.transpose(-1, -2) @ J
    g = (J_weighted.transpose(-1, -2) @ residual.flatten(1, 2).unsqueeze(-1)).squeeze(-1)
    return NormalEquations(cost, H, g)


def check_correspondences(
    points_image: Tensor, points_model: Tensor, K: Tensor, weights: Tensor | None, name: str = "weights"
) -> None:
    """Raise ValueError unless the tensors are (B, N, 2), (B, N, 3), (B, 3, 3) and (B, N) in float32 or float64."""
    if points_image.dim() != 3 or points_image.shape[-1] != 2:
        raise ValueError(f"points_image must have shape (B, N, 2), got {tuple(points_image.shape)}")
    batch, count = points_image.shape[:2]
    if points_model.shape != (batch, count, 3):
        raise ValueError(f"points_model must have shape {(batch, count, 3)}, got {tuple(points_model.shape)}")
    if K.shape != (batch, 3, 3):
        raise ValueError(
            f"K must have shape {(batch, 3, 3)}, one matrix per problem (use expand), got {tuple(K.shape)}"
        )
    if weights is not None and weights.shape != (batch, count):
        raise ValueError(f"{name} must have shape {(batch, count)}, got {tuple(weights.shape)}")
    dtypes = {points_image.dtype, points_model.dtype, K.dtype}
    if len(dtypes) != 1 or points_image.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            "points_image, points_model and K must share float32 or float64 (poses need more digits than half "
            f"precision has), got {points_image.dtype}, {points_model.dtype} and {K.dtype}"
        )


def usable_coordinates(points: Tensor) -> Tensor:
    """Which points (..., d) are numbers whose fourth powers do not overflow: a bool mask (...)."""
    return (points.abs() < torch.finfo(points.dtype).max ** 0.25).all(-1)

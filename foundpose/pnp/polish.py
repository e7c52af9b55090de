"""Polish of poses by minimising the reprojection error."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points
from foundpose.optimization import (
    Differentiation,
    LevenbergMarquardtResult,
    NormalEquations,
    RobustLoss,
    attach_implicit_gradient,
    optimise_pose,
)


class LocalFrame(NamedTuple):
    """The frame that a pose is optimised in: ``x_camera = origin + size * (T_local @ x_local)``.

    It sits at the object's centroid in units of the object's size, where rotation and translation hardly couple; in
    the camera frame a narrow field of view leaves float32 few digits.

    Attributes:
        centroid: (B, 3) weighted mean of the model points, mesh units.
        size: (B, 1) root mean square distance from it, mesh units.
        origin: (B, 3) the centroid in the camera frame at the initial pose, mesh units.
    """

    centroid: Tensor
    size: Tensor
    origin: Tensor

    @classmethod
    def at(cls, T: Tensor, points_model: Tensor, weights: Tensor) -> "LocalFrame":
        """Frame of weighted points (B, N, 3) at poses (B, 4, 4)."""
        total = weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
        centroid = (weights.unsqueeze(-1) * points_model).sum(-2) / total
        centred = points_model - centroid.unsqueeze(-2)
        # Its value only scales the problem, so it has no gradient.
        variance = (weights * centred.square().sum(-1)).sum(-1, keepdim=True).detach() / total.detach()
        size = torch.where(variance > 0, variance, torch.ones_like(variance)).sqrt()
        origin = transform_points(T, centroid.unsqueeze(-2)).squeeze(-2)
        return cls(centroid, size, origin)

    def pose_to_local(self, T: Tensor) -> Tensor:
        """``T_local`` of the pose that the frame was made at: a pure rotation."""
        return make_transform(T[:, :3, :3], torch.zeros_like(self.origin))

    def pose_from_local(self, T_local: Tensor) -> Tensor:
        """``T_camera_from_model`` of a pose in this frame."""
        R = T_local[:, :3, :3]
        t = self.origin + self.size * T_local[:, :3, 3] - (R @ self.centroid.unsqueeze(-1)).squeeze(-1)
        return make_transform(R, t)

    def twist_to_camera(self) -> Tensor:
        """Matrices (B, 6, 6) that turn twists (v, ω) of the local frame into the camera frame's; constants."""
        origin, size = self.origin.detach(), self.size.detach()
        identity = torch.eye(3, dtype=origin.dtype, device=origin.device).expand(len(origin), 3, 3)
        # v at the local origin is size v + origin × ω at the camera's.
        cross = torch.linalg.cross(origin.unsqueeze(-1).expand(-1, 3, 3), identity, dim=-2)
        upper = torch.cat([size.unsqueeze(-1) * identity, cross], dim=-1)
        return torch.cat([upper, torch.cat([torch.zeros_like(cross), identity], dim=-1)], dim=-2)

    def points(self, points_model: Tensor) -> Tensor:
        """Model points (B, N, 3) in units of this frame."""
        return (points_model - self.centroid.unsqueeze(-2)) / self.size.unsqueeze(-1)


def polish_pnp(
    T_camera_from_model: Tensor,
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    weights: Tensor | None = None,
    *,
    loss: RobustLoss | None = None,
    max_iterations: int = 10,
    tolerance: float | None = None,
    differentiation: Differentiation = "implicit",
) -> tuple[LevenbergMarquardtResult, LocalFrame]:
    """Minimise ``½ Σ w ρ(‖π(K, T x) − u‖²)`` over the pose, one problem per batch element.

    Args:
        T_camera_from_model: (B, 4, 4) initial poses with every weighted point in front of the camera.
        points_image: (B, N, 2) pixels.
        points_model: (B, N, 3) mesh units.
        K: (B, 3, 3) intrinsics.
        weights: (B, N) non-negative; a bool mask works too. None means all ones. Points of weight zero are ignored,
            whatever they are.
        loss: ρ on squared pixel distances; None means least squares.
        max_iterations: Levenberg-Marquardt iterations.
        tolerance: relative decrease of the cost that counts as converged; None means a few units of rounding.
        differentiation: gradient of the optimum ("implicit") or of the steps taken ("unrolled").

    Returns:
        A :class:`~foundpose.optimization.LevenbergMarquardtResult` with costs in px², and the frame that its ``H``
        belongs to. A sample whose initial pose has a weighted point behind the camera, that has no weighted point, or
        any number in which is not finite, comes back as it was with ``failed`` set and without a gradient.

    Raises:
        ValueError: shapes do not fit, or an unknown mode of differentiation.

    Differentiable w.r.t. ``points_image``, ``points_model``, ``K`` and ``weights``, and in mode "unrolled" w.r.t.
    the initial poses. The weight of a point that is left out (zero) has no gradient.

    Source: paper, section "Pose estimation from 2D-3D correspondences".
    """
    check_correspondences(points_image, points_model, K, weights)
    weights = unit_weights(points_image) if weights is None else weights.to(points_image.dtype)
    finite = usable_coordinates(points_image) & usable_coordinates(points_model)
    sane = torch.isfinite(T_camera_from_model).all(-1).all(-1) & torch.isfinite(K).all(-1).all(-1)
    sane = sane & (torch.isfinite(weights) & (finite | (weights == 0))).all(-1)
    # Stand-ins without weight, which fail: no NaN may enter the graph, not even multiplied by zero.
    given, T_camera_from_model = T_camera_from_model, _where(sane, T_camera_from_model, 4)
    K = _where(sane, K, 3)
    weights = weights.masked_fill(~(sane.unsqueeze(-1) & (weights > 0)), 0.0)
    points_image = points_image.masked_fill((weights == 0).unsqueeze(-1), 0.0)
    points_model = points_model.masked_fill((weights == 0).unsqueeze(-1), 0.0)
    if differentiation == "implicit":
        # The optimum does not depend on the frame that it is looked for in, nor on where the search begins.
        T_camera_from_model = T_camera_from_model.detach()
        frame = LocalFrame.at(T_camera_from_model, points_model.detach(), weights.detach())
    else:
        frame = LocalFrame.at(T_camera_from_model, points_model, weights)
    points_local = frame.points(points_model)

    def evaluate(T_local: Tensor) -> NormalEquations:
        return reprojection_equations(T_local, points_local, points_image, K, weights, frame, loss)

    # Pixel coordinates carry rounding errors of a few units in their last place.
    rounding = 8.0 * torch.finfo(points_image.dtype).eps * K.detach().abs().amax((-1, -2))
    result = optimise_pose(
        evaluate,
        frame.pose_to_local(T_camera_from_model),
        differentiation=differentiation,
        max_iterations=max_iterations,
        tolerance=tolerance,
        floor=weights.detach().sum(-1) * rounding.square(),
    )
    T = torch.where(sane[:, None, None], frame.pose_from_local(result.T), given)
    return result._replace(T=T), frame


def attach_pnp_gradient(
    T_camera_from_model: Tensor,
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    weights: Tensor,
    loss: RobustLoss | None = None,
) -> tuple[Tensor, Tensor]:
    """Poses that minimise the reprojection error, with the gradient of that optimum; see :func:`polish_pnp`.

    Returns:
        The poses, which do not change by a single bit, and which of them have a well-conditioned optimum (B,); the
        others have a gradient of zero.
    """
    T = T_camera_from_model.detach()
    weights = weights.to(points_image.dtype)
    frame = LocalFrame.at(T, points_model.detach(), weights.detach())
    points_local = frame.points(points_model)
    optimum = attach_implicit_gradient(
        lambda T_local: reprojection_equations(T_local, points_local, points_image, K, weights, frame, loss),
        frame.pose_to_local(T),
    )
    attached = frame.pose_from_local(optimum.T)
    return T + (attached - attached.detach()), optimum.regular


def _where(sane: Tensor, matrices: Tensor, size: int) -> Tensor:
    """Identity matrices in place of those that are not sane."""
    identity = torch.eye(size, dtype=matrices.dtype, device=matrices.device)
    return torch.where(sane[:, None, None], matrices, identity)


def unit_weights(points_image: Tensor) -> Tensor:
    """Weights of one for points (B, N, 2)."""
    return torch.ones_like(points_image[..., 0])


def reprojection_equations(
    T_local: Tensor,
    points_local: Tensor,
    points_image: Tensor,
    K: Tensor,
    weights: Tensor,
    frame: LocalFrame,
    loss: RobustLoss | None = None,
) -> NormalEquations:
    """Linearise the reprojection error of ``frame.origin + frame.size * (T_local @ points_local)``.

    Args:
        T_local: (B, 4, 4).
        points_local: (B, N, 3).
        points_image: (B, N, 2) pixels.
        K: (B, 3, 3) intrinsics.
        weights: (B, N).
        frame: where the local frame lies.
        loss: ρ on squared pixel distances; None means least squares.

    Returns:
        The normal equations of ``T_local ← exp(δ) @ T_local``; the cost is infinite where a weighted point
        lies behind the camera. Differentiable w.r.t. all tensors.
    """
    pixels, depth, J = project_in_frame(T_local, points_local, K, frame)
    in_front = depth > 0
    residual = pixels - points_image.transpose(1, 2)
    squared = residual.square().sum(1)
    rho, slope = (squared, None) if loss is None else loss(squared)
    used = weights > 0
    zero = torch.zeros_like(rho)
    # Points out of use may lie anywhere, also where their residual overflows.
    cost = 0.5 * torch.where(used, weights * rho, zero).sum(-1)
    cost = cost.masked_fill((used & ~in_front).any(-1), torch.inf)
    share = torch.where(used & in_front, weights if slope is None else weights * slope, zero)
    weighted = (J * share[:, None, None]).flatten(2)
    H = weighted @ J.flatten(2).transpose(1, 2)
    g = (weighted @ residual.flatten(1).unsqueeze(-1)).squeeze(-1)
    return NormalEquations(cost, H, g)


def project_in_frame(
    T_local: Tensor, points_local: Tensor, K: Tensor, frame: LocalFrame
) -> tuple[Tensor, Tensor, Tensor]:
    """Project ``frame.origin + frame.size * (T_local @ points_local)``, with derivatives.

    Points come last in what is returned: operations on many points for a few coordinates are fast that way.

    Args:
        T_local: (B, 4, 4).
        points_local: (B, N, 3).
        K: (B, 3, 3) intrinsics.
        frame: where the local frame lies.

    Returns:
        Pixels (B, 2, N), depths (B, N) in mesh units, and the derivatives (B, 6, 2, N) of the pixels in δ for
        ``T_local ← exp(δ) @ T_local``. Where the depth is not positive, pixels and derivatives are finite but mean
        nothing. Differentiable w.r.t. all tensors.
    """
    rotated = torch.baddbmm(T_local[:, :3, 3:], T_local[:, :3, :3], points_local.transpose(1, 2))
    points_camera = frame.origin.unsqueeze(-1) + frame.size.unsqueeze(-1) * rotated
    depth = points_camera[:, 2:]
    inverse = 1.0 / torch.where(depth > 0, depth, torch.ones_like(depth))
    centre, focal = K[:, :2, 2:], K[:, :2, :2]
    from_centre = focal @ (points_camera[:, :2] * inverse)
    # d pixels / d points_camera times size, then d points_camera / d δ = size [I, −[rotated]×].
    scaled = inverse * frame.size.unsqueeze(-1)
    by_plane = focal.transpose(1, 2).unsqueeze(-1) * scaled.unsqueeze(1)
    by_depth = from_centre * -scaled
    by_point = torch.cat([by_plane, by_depth.unsqueeze(1)], dim=1)  # (B, 3, 2, N)
    by_rotation = torch.linalg.cross(rotated.unsqueeze(2).expand_as(by_point), by_point, dim=1)
    return from_centre + centre, depth.squeeze(1), torch.cat([by_point, by_rotation], dim=1)


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


def invertible_intrinsics(K: Tensor) -> Tensor:
    """Which intrinsics (B, 3, 3) have an inverse to the precision of the numbers: (B,) bool."""
    K = K.detach()
    # Hadamard's inequality bounds the determinant by the product of the rows' lengths.
    bound = torch.linalg.vector_norm(K, dim=-1).prod(-1)
    return torch.isfinite(bound) & (torch.linalg.det(K).abs() > 8.0 * torch.finfo(K.dtype).eps * bound)


def rays_of_usable_pixels(points_image: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Rays through pixels, where there may be pixels that are no numbers and intrinsics without inverse.

    Args:
        points_image: (B, N, 2) pixels.
        K: (B, 3, 3) intrinsics.

    Returns:
        Rays (B, N, 3) in the camera frame with z = 1, and which of them are of use (B, N). The others are fixed
        numbers. Differentiable w.r.t. both arguments; what is not of use has a gradient of zero.
    """
    invertible = invertible_intrinsics(K)
    K = torch.where(invertible[:, None, None], K, torch.eye(3, dtype=K.dtype, device=K.device))
    usable = usable_coordinates(points_image) & invertible.unsqueeze(-1)
    pixels = torch.where(usable.unsqueeze(-1), points_image, torch.zeros_like(points_image))
    # Written out, where pixel_rays has a matrix product whose rounding may depend on the batch size.
    inverse = torch.linalg.inv(K).unsqueeze(1)
    rays = inverse[..., 0] * pixels[..., :1] + inverse[..., 1] * pixels[..., 1:] + inverse[..., 2]
    return rays, usable

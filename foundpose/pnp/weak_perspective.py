"""Poses under weak perspective: the start of EPnP's last case, mirrored poses, and alignment of point sets."""

import torch
from torch import Tensor

from foundpose.geometry.cameras import axis_rotation_to_ray
from foundpose.geometry.transforms import make_transform, project_to_rotation, transform_points

# Directions in which the object extends less than this share of its size count for little: an affine camera
# fitted to nearly flat points would get its slope across the plane from noise.
_FLATNESS = 0.05


def weak_perspective_depths(bearings: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Distances of points along their rays, by a scaled orthographic camera.

    The affine camera that maps the points to the plane perpendicular to the mean ray is fitted by
    least squares. Its larger singular value is the scale; the ratio of the two is the cosine by which a flat
    object is foreshortened, which leaves two mirrored slopes (they coincide for solid objects).

    Args:
        bearings: (S, N, 3) unit rays in the camera frame.
        points: (S, N, 3), weighted mean zero, of about unit size.
        weights: (S, N), not negative, sum one.

    Returns:
        (S, 2, N) distances from the camera centre, mirrored slopes along dimension 1; finite for any finite
        input. Starts for an optimisation: not differentiable.

    Source: scaled orthography as in DeMenthon and Davis, "Model-based object pose in 25 lines of code", 1995.
    """
    bearings, points, weights = bearings.detach(), points.detach(), weights.detach()
    eps = torch.finfo(points.dtype).eps
    column = weights.unsqueeze(-1)
    mean = (column * bearings).sum(-2)
    R_view_from_camera = axis_rotation_to_ray(_camera_side(mean, eps))
    rays = bearings @ R_view_from_camera.transpose(-1, -2)
    cosine = rays[..., 2].clamp(min=0.05)
    plane = rays[..., :2] / cosine.unsqueeze(-1)
    plane = plane - (column * plane).sum(-2, keepdim=True)

    weighted = column * points
    spread = weighted.transpose(-1, -2) @ points
    trace = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    ridge = (_FLATNESS**2 * trace + eps) * torch.eye(3, dtype=points.dtype, device=points.device)
    affine = torch.linalg.solve_ex(spread + ridge, weighted.transpose(-1, -2) @ plane)[0]  # (S, 3, 2)

    # Singular value decomposition of a 3 × 2 matrix by the angle of its Gram matrix.
    first, second = affine.unbind(-1)
    p, q, s = (first * first).sum(-1), (first * second).sum(-1), (second * second).sum(-1)
    angle = (0.5 * torch.atan2(2.0 * q, p - s)).unsqueeze(-1)
    major = angle.cos() * first + angle.sin() * second
    minor = angle.cos() * second - angle.sin() * first
    sigma_major = torch.linalg.vector_norm(major, dim=-1, keepdim=True).clamp(min=eps)
    sigma_minor = torch.linalg.vector_norm(minor, dim=-1, keepdim=True).clamp(min=eps * eps)
    axis_major, axis_minor = major / sigma_major, minor / sigma_minor
    normal = torch.linalg.cross(axis_major, axis_minor)
    ratio = (sigma_minor / sigma_major).clamp(max=1.0)
    slope = (1.0 - ratio * ratio).clamp(min=0.0).sqrt()
    towards_view = torch.stack(
        [ratio * normal - slope * axis_minor, ratio * normal + slope * axis_minor], dim=-2
    )
    depth = 1.0 / sigma_major.unsqueeze(-1) + towards_view @ points.transpose(-1, -2)
    return depth / cosine.unsqueeze(-2)


def _camera_side(mean: Tensor, eps: float) -> Tensor:
    """The mean ray, or the optical axis where rays cancel out or look backwards."""
    axis = torch.zeros_like(mean)
    axis[..., 2] = 1.0
    return torch.where(mean[..., 2:] > eps, mean, axis)


def mirrored_poses(T: Tensor, points_model: Tensor, weights: Tensor) -> Tensor:
    """The other poses under which flat objects look almost the same.

    Seen from afar, a flat object and its mirror image in depth have the same projection (Necker's reversal). The
    points are mirrored at the plane through their centroid across the line of sight, and the object is aligned with
    them; a solid object cannot be, and gives a pose with a large error.

    Args:
        T: (B, 4, 4) poses.
        points_model: (B, N, 3) mesh units.
        weights: (B, N), not negative.

    Returns:
        (B, 4, 4), finite for finite input. A start for an optimisation: not differentiable.
    """
    T, points_model, weights = T.detach(), points_model.detach(), weights.detach()
    weights = weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    points = transform_points(T, points_model)
    centroid = (weights.unsqueeze(-1) * points).sum(-2, keepdim=True)
    sight = torch.nn.functional.normalize(centroid, dim=-1)
    depth = ((points - centroid) * sight).sum(-1, keepdim=True)
    return align_points(points - 2.0 * depth * sight, points_model, weights)


def align_points(points_b: Tensor, points_a: Tensor, weights: Tensor) -> Tensor:
    """Rigid transformation that maps points a to points b in the weighted least-squares sense.

    Args:
        points_b: (..., N, 3).
        points_a: (..., N, 3), leading dimensions broadcast.
        weights: (..., N), not negative, sum one.

    Returns:
        ``T_b_from_a`` (..., 4, 4), finite for any finite input. Differentiable w.r.t. the points where the
        alignment is unique.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    column = weights.unsqueeze(-1)
    mean_b = (column * points_b).sum(-2, keepdim=True)
    mean_a = (column * points_a).sum(-2, keepdim=True)
    covariance = (column * (points_b - mean_b)).transpose(-1, -2) @ (points_a - mean_a)
    R = project_to_rotation(covariance)
    t = mean_b.squeeze(-2) - (R @ mean_a.transpose(-1, -2)).squeeze(-1)
    return make_transform(R, t)

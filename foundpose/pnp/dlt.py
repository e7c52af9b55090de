"""The direct linear transform as a minimal solver: kornia's."""

import torch
from kornia.geometry import solve_pnp_dlt
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points
from foundpose.pnp.problem import MinimalSolution

# Least spread of the points along their thinnest direction, of their root mean square distance from the centroid.
# kornia refuses a whole batch for one sample that is flat.
_LEAST_SPREAD = 1e-3


def solve_dlt_minimal(rays: Tensor, points_model: Tensor) -> MinimalSolution:
    """Poses from samples of at least six correspondences that are not on a plane.

    Args:
        rays: (S, n, 3) rays in the camera frame with z = 1, finite.
        points_model: (S, n, 3) mesh units, finite.

    Returns:
        A :class:`~foundpose.pnp.problem.MinimalSolution`; flat samples are degenerate.

    Source: Hartley and Zisserman, "Multiple view geometry", section 7.1; ``kornia.geometry.solve_pnp_dlt``.
    """
    spread = _shape(points_model)
    seen = _shape(rays[..., :2])
    degenerate = ~((spread > _LEAST_SPREAD) & (seen > _LEAST_SPREAD))
    # A sample that determines a pose stands in for those that do not.
    S, n = rays.shape[:2]
    some = torch.linspace(0.0, 1.0, n, dtype=rays.dtype, device=rays.device)
    solid = torch.stack([some, some.square(), some.square() * some], dim=-1)
    ahead = torch.stack([solid[:, 0], solid[:, 1], solid[:, 2] + 4.0], dim=-1)
    flat = degenerate[:, None, None]
    points = torch.where(flat, solid, points_model)
    pixels = torch.where(flat, ahead[:, :2] / ahead[:, 2:], rays[..., :2])
    K = torch.eye(3, dtype=rays.dtype, device=rays.device).expand(S, 3, 3)
    found = solve_pnp_dlt(points, pixels, K)
    T = make_transform(found[..., :3], found[..., 3])
    degenerate = degenerate | ~torch.isfinite(T).flatten(1).all(dim=1)
    T = torch.where(degenerate[:, None, None], torch.eye(4, dtype=T.dtype, device=T.device), T)
    valid = ~degenerate & (transform_points(T, points_model)[..., 2] > 0).all(dim=1)
    return MinimalSolution(T, valid, degenerate)


def _shape(points: Tensor) -> Tensor:
    """Smallest spread (S,) of points (S, n, d) relative to their largest; 0 for coincident ones."""
    centred = points - points.mean(dim=1, keepdim=True)
    values = torch.linalg.svdvals(centred)
    return values[:, -1] / values[:, 0].clamp(min=torch.finfo(points.dtype).tiny)

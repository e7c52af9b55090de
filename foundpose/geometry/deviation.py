"""How far poses are from the truth, and poses that are off by so much."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, rotation_angle, se3_exp, transform_points

CONVERGED_DEGREES, CONVERGED_LATERAL, CONVERGED_DEPTH = 1.0, 0.01, 0.05


class PoseDeviation(NamedTuple):
    """How far poses are from the truth.

    Attributes:
        rotation: (...) degrees.
        lateral: (...) displacement across the line of sight, in the unit asked for.
        depth: (...) displacement along it, in the same unit, not negative.
    """

    rotation: Tensor
    lateral: Tensor
    depth: Tensor

    @property
    def translation(self) -> Tensor:
        """Length (...) of the whole displacement."""
        return torch.hypot(self.lateral, self.depth)

    def converged(self) -> Tensor:
        """Within 1 degree, 1 % of the unit laterally and 5 % in depth (...), bool."""
        close = (self.rotation < CONVERGED_DEGREES) & (self.lateral < CONVERGED_LATERAL)
        return close & (self.depth < CONVERGED_DEPTH)


def pose_deviation(
    T: Tensor, T_true: Tensor, unit: float | Tensor = 1.0, centre: Tensor | None = None
) -> PoseDeviation:
    """Deviations of poses (..., 4, 4) from true ones (leading dimensions broadcast) in a camera's frame.

    Args:
        T: estimated poses.
        T_true: true poses; the point looked at must lie in front of the camera.
        unit: of displacements, such as the object's diameter, in mesh units.
        centre: (..., 3) point of the model whose displacement counts; None: the origin.
    """
    found, true = T[..., :3, 3], T_true[..., :3, 3]
    if centre is not None:
        found, true = (transform_points(A, centre.unsqueeze(-2)).squeeze(-2) for A in (T, T_true))
    sight = torch.nn.functional.normalize(true, dim=-1)
    offset = found - true
    along = (offset * sight).sum(-1)
    lateral = torch.linalg.vector_norm(offset - along.unsqueeze(-1) * sight, dim=-1)
    rotation = torch.rad2deg(rotation_angle(T[..., :3, :3], T_true[..., :3, :3]))
    return PoseDeviation(rotation, lateral / unit, along.abs() / unit)


def perturbed_poses(T: Tensor, degrees: Tensor, distance: Tensor, generator: torch.Generator) -> Tensor:
    """Turn poses about the object's origin, and move it, in random directions.

    Args:
        T: (n, 4, 4) on the CPU.
        degrees: (n,) angles of the turns.
        distance: (n,) lengths of the moves, mesh units.
        generator: of the directions.

    Returns:
        (n, 4, 4).
    """
    axis, direction = torch.nn.functional.normalize(
        torch.randn(2, len(T), 3, generator=generator), dim=-1
    ).to(T)
    turn = axis * (degrees.to(T) * (math.pi / 180.0)).unsqueeze(-1)
    R = se3_exp(torch.cat([torch.zeros_like(turn), turn], dim=-1))[:, :3, :3]
    t = T[:, :3, 3] + direction * distance.to(T).unsqueeze(-1)
    return make_transform(R @ T[:, :3, :3], t)

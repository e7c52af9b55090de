"""How far off a pose may be for a refiner to find it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry import axis_rotation_to_ray, make_transform, rotation_angle
from foundpose.geometry.transforms import se3_exp

CONVERGED_DEGREES, CONVERGED_LATERAL, CONVERGED_DEPTH = 1.0, 0.01, 0.05


class PoseDeviation(NamedTuple):
    """How far poses are from the truth.

    Attributes:
        rotation: (...) degrees.
        lateral: (...) displacement across the line of sight, diameters.
        depth: (...) displacement along it, diameters, not negative.
    """

    rotation: Tensor
    lateral: Tensor
    depth: Tensor

    def converged(self) -> Tensor:
        """Within 1 degree, 1 % of the diameter laterally and 5 % in depth (...), bool."""
        close = (self.rotation < CONVERGED_DEGREES) & (self.lateral < CONVERGED_LATERAL)
        return close & (self.depth < CONVERGED_DEPTH)


def pose_deviation(T: Tensor, T_true: Tensor, diameter: float | Tensor) -> PoseDeviation:
    """Deviations of poses (..., 4, 4) from true ones (leading dimensions broadcast) in a camera's frame.

    Args:
        T: estimated poses.
        T_true: true poses; the object's origin must lie in front of the camera.
        diameter: of the object, mesh units.
    """
    rotation = torch.rad2deg(rotation_angle(T[..., :3, :3], T_true[..., :3, :3]))
    sight = torch.nn.functional.normalize(T_true[..., :3, 3], dim=-1)
    offset = (T[..., :3, 3] - T_true[..., :3, 3]) / diameter
    along = (offset * sight).sum(-1)
    lateral = torch.linalg.vector_norm(offset - along.unsqueeze(-1) * sight, dim=-1)
    return PoseDeviation(rotation, lateral, along.abs())


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


def nearest_templates(T_crop_from_model: Tensor, T_template_from_model: Tensor) -> Tensor:
    """Template (n,) whose orientation towards its camera is closest to each pose's (n, 4, 4).

    A template shows the object from its own camera; what counts is the direction from which the object is seen and
    the roll, so rotations are compared after turning each camera onto the object.
    """
    views = [
        turned_to_object(T)[..., :3, :3]
        for T in (T_crop_from_model, T_template_from_model.to(T_crop_from_model))
    ]
    return rotation_angle(views[0][:, None], views[1][None]).argmin(dim=1)


def turned_to_object(T: Tensor) -> Tensor:
    """Poses (n, 4, 4) in cameras turned, without roll, onto the object's origin."""
    R = axis_rotation_to_ray(T[..., :3, 3])
    return make_transform(R, torch.zeros_like(T[..., :3, 3])) @ T

"""Sets of orientations that cover SO(3)."""

import math

import torch
import torch.nn.functional as F
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, quaternion_to_rotation_matrix
from torch import Tensor

from foundpose.utils.settings import Configured, Setting

# The spiral's two irrational steps: sqrt(2) and the positive root of psi^4 = psi + 4 (Alexa 2022).
_PHI = math.sqrt(2.0)
_PSI = 1.533751168755204288118041


def super_fibonacci_rotations(count: int) -> Tensor:
    """Nearly uniform rotations by super-Fibonacci spirals.

    Args:
        count: number of rotations, at least 1. 800 lie about 25 degrees apart.

    Returns:
        (count, 3, 3) float64 rotations.

    Raises:
        ValueError: ``count`` is not positive.

    Source: Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    s = torch.arange(count, dtype=torch.float64) + 0.5
    alpha, beta = 2.0 * math.pi * s / _PHI, 2.0 * math.pi * s / _PSI
    r, R = (s / count).sqrt(), (1.0 - s / count).sqrt()
    quaternions = torch.stack([r * alpha.sin(), r * alpha.cos(), R * beta.sin(), R * beta.cos()], dim=-1)
    return quaternion_to_rotation_matrix(quaternions)


def sphere_inplane_rotations(num_views: int = 57, num_inplane: int = 14) -> Tensor:
    """View directions on a Fibonacci sphere times evenly spaced in-plane rotations.

    Args:
        num_views: number of viewing directions.
        num_inplane: number of rotations about the optical axis for each of them.

    Returns:
        (num_views * num_inplane, 3, 3) float64 rotations ``R_camera_from_model``, in-plane angle fastest.

    Raises:
        ValueError: a number is not positive.
    """
    if num_views < 1 or num_inplane < 1:
        raise ValueError(f"num_views and num_inplane must be at least 1, got {num_views} and {num_inplane}")
    index = torch.arange(num_views, dtype=torch.float64)
    z = 1.0 - (2.0 * index + 1.0) / num_views
    azimuth = index * math.pi * (3.0 - math.sqrt(5.0))
    radius = (1.0 - z * z).sqrt()
    forward = -torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)
    # Any frame about the direction serves: the in-plane angles sweep it evenly.
    pole = torch.zeros_like(forward)
    pole.scatter_(1, forward.abs().argmin(dim=1, keepdim=True), 1.0)
    right = F.normalize(torch.linalg.cross(pole, forward), dim=-1)
    R_views = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-2)
    angle = torch.arange(num_inplane, dtype=torch.float64) * (2.0 * math.pi / num_inplane)
    R_inplane = axis_angle_to_rotation_matrix(F.pad(angle[:, None], (2, 0)))
    return (R_inplane[None] @ R_views[:, None]).reshape(-1, 3, 3)


class SuperFibonacci(Configured):
    """Orientations on super-Fibonacci spirals; see :func:`super_fibonacci_rotations`.

    Args:
        count: number of orientations.
    """

    def __init__(self, count: int = 800) -> None:
        super().__init__()
        self.count = count

    def forward(self) -> Tensor:
        """Rotations (count, 3, 3), float64."""
        return super_fibonacci_rotations(self.count)

    def settings(self) -> dict[str, Setting]:
        """Settings by name."""
        return {"count": self.count}


class SphereInplane(Configured):
    """View directions times in-plane rotations; see :func:`sphere_inplane_rotations`.

    Args:
        num_views: number of viewing directions.
        num_inplane: number of in-plane rotations for each of them.
    """

    def __init__(self, num_views: int = 57, num_inplane: int = 14) -> None:
        super().__init__()
        self.num_views = num_views
        self.num_inplane = num_inplane

    def forward(self) -> Tensor:
        """Rotations (num_views * num_inplane, 3, 3), float64."""
        return sphere_inplane_rotations(self.num_views, self.num_inplane)

    def settings(self) -> dict[str, Setting]:
        """Settings by name."""
        return {"num_views": self.num_views, "num_inplane": self.num_inplane}

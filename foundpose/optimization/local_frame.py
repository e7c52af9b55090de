"""The frame that a pose is optimised in, and projection from it."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points

# Smallest depth that is divided by, in units of the object's size: no camera sees anything from so close.
_NEAREST = 1e-3


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


class LocalProjection:
    """Projects points from a local frame into an image, with derivatives.

    Args:
        frame: where the local frames lie.
        points_model: (B, N, 3) mesh units.
        K: (B, 3, 3) intrinsics.
    """

    def __init__(self, frame: LocalFrame, points_model: Tensor, K: Tensor) -> None:
        # Whatever does not change with the pose is computed here. Points come last: operations on many points for a
        # few coordinates are fast that way.
        points = (points_model - frame.centroid.unsqueeze(-2)) / frame.size.unsqueeze(-1)
        self.points = points.transpose(1, 2).contiguous()
        self.origin = (frame.origin / frame.size).unsqueeze(-1)
        self.focal, self.centre = K[:, :2].split([2, 1], dim=-1)
        self.slopes = self.focal.transpose(1, 2).unsqueeze(-1).expand(-1, -1, -1, points.shape[1])

    def __call__(self, T_local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project.

        Args:
            T_local: (B, 4, 4).

        Returns:
            Pixels (B, 2, N), depths (B, N) in units of the object's size, and the derivatives (B, 6, 2, N) of the
            pixels in δ for ``T_local ← exp(δ) @ T_local``. Where the depth is not positive, pixels and derivatives
            are finite but mean nothing. Differentiable w.r.t. all tensors.
        """
        R, t = T_local[:, :3].split([3, 1], dim=-1)
        rotated = torch.baddbmm(t, R, self.points)
        plane, depth = (rotated + self.origin).split([2, 1], dim=1)
        inverse = depth.clamp(min=_NEAREST).reciprocal()
        from_centre = torch.bmm(self.focal, plane * inverse)
        # d pixels / d points in units of the size, then d points / d δ = [I, −[rotated]×].
        by_point = torch.cat([self.slopes, -from_centre.unsqueeze(1)], dim=1) * inverse.unsqueeze(1)
        by_rotation = torch.linalg.cross(rotated.unsqueeze(2), by_point, dim=1)
        return from_centre + self.centre, depth.squeeze(1), torch.cat([by_point, by_rotation], dim=1)

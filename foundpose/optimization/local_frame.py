"""The frame that a pose is optimised in, and projection from it."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points


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

    def points(self, points_model: Tensor) -> Tensor:
        """Model points (B, N, 3) in units of this frame."""
        return (points_model - self.centroid.unsqueeze(-2)) / self.size.unsqueeze(-1)

    def project(self, T_local: Tensor, points_local: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points of this frame, with derivatives.

        Points come last in what is returned: operations on many points for a few coordinates are fast that way.

        Args:
            T_local: (B, 4, 4).
            points_local: (B, N, 3).
            K: (B, 3, 3) intrinsics.

        Returns:
            Pixels (B, 2, N), depths (B, N) in mesh units, and the derivatives (B, 6, 2, N) of the pixels in δ for
            ``T_local ← exp(δ) @ T_local``. Where the depth is not positive, pixels and derivatives are finite but
            mean nothing. Differentiable w.r.t. all tensors.
        """
        size = self.size.unsqueeze(-1)
        rotated = torch.baddbmm(T_local[:, :3, 3:], T_local[:, :3, :3], points_local.transpose(1, 2))
        points_camera = self.origin.unsqueeze(-1) + size * rotated
        depth = points_camera[:, 2:]
        inverse = torch.where(depth > 0, depth, 1.0).reciprocal()
        centre, focal = K[:, :2, 2:], K[:, :2, :2]
        from_centre = torch.bmm(focal, points_camera[:, :2] * inverse)
        # d pixels / d points_camera times size, then d points_camera / d δ = size [I, −[rotated]×].
        scaled = inverse * size
        by_plane = focal.transpose(1, 2).unsqueeze(-1) * scaled.unsqueeze(1)
        by_depth = from_centre * -scaled
        by_point = torch.cat([by_plane, by_depth.unsqueeze(1)], dim=1)  # (B, 3, 2, N)
        by_rotation = torch.linalg.cross(rotated.unsqueeze(2).expand_as(by_point), by_point, dim=1)
        return from_centre + centre, depth.squeeze(1), torch.cat([by_point, by_rotation], dim=1)

"""A batch of Perspective-n-Point problems, and what a minimal solver makes of one."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.cameras import pixel_rays


@dataclass(frozen=True, eq=False)
class PnpProblem:
    """2D-3D correspondences of B problems, padded; shapes and dtypes are checked once, here.

    Args:
        points_image: (B, N, 2) pixels.
        points_model: (B, N, 3) mesh units.
        K: (B, 3, 3) intrinsics.
        valid: (B, N) bool, which correspondences exist; None means all.
        weights: (B, N), how much each counts, not negative; None means one.

    Raises:
        ValueError: shapes or dtypes do not fit.
    """

    points_image: Tensor
    points_model: Tensor
    K: Tensor
    valid: Tensor = None  # type: ignore[assignment]  # a tensor from the constructor on
    weights: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        image, model, K = self.points_image, self.points_model, self.K
        if image.dim() != 3 or image.shape[-1] != 2:
            raise ValueError(f"points_image must have shape (B, N, 2), got {tuple(image.shape)}")
        batch, count = image.shape[:2]
        if model.shape != (batch, count, 3):
            raise ValueError(f"points_model must have shape {(batch, count, 3)}, got {tuple(model.shape)}")
        if K.shape != (batch, 3, 3):
            raise ValueError(
                f"K must have shape {(batch, 3, 3)}, one matrix per problem (use expand), got {tuple(K.shape)}"
            )
        if len({image.dtype, model.dtype, K.dtype}) != 1 or image.dtype not in (torch.float32, torch.float64):
            raise ValueError(
                "points_image, points_model and K must share float32 or float64 (poses need more digits than half "
                f"precision has), got {image.dtype}, {model.dtype} and {K.dtype}"
            )
        valid, weights = self.valid, self.weights
        valid = torch.ones_like(image[..., 0], dtype=torch.bool) if valid is None else valid.bool()
        weights = torch.ones_like(image[..., 0]) if weights is None else weights.to(image.dtype)
        for name, numbers in (("valid", valid), ("weights", weights)):
            self.check_numbers(name, numbers)
            object.__setattr__(self, name, numbers)

    def check_numbers(self, name: str, numbers: Tensor) -> None:
        """Raise ValueError unless there is one number for each correspondence."""
        if numbers.shape != self.points_image.shape[:2]:
            expected = tuple(self.points_image.shape[:2])
            raise ValueError(f"{name} must have shape {expected}, got {tuple(numbers.shape)}")

    def take(self, index: Tensor | slice) -> "PnpProblem":
        """Some of the problems."""
        return PnpProblem(
            self.points_image[index],
            self.points_model[index],
            self.K[index],
            self.valid[index],
            self.weights[index],
        )

    def repeat(self, times: int) -> "PnpProblem":
        """Each problem several times in a row."""
        if times == 1:
            return self
        return self.take(torch.arange(len(self.K), device=self.K.device).repeat_interleave(times))

    def detach(self) -> "PnpProblem":
        """The same numbers as constants."""
        return PnpProblem(
            self.points_image.detach(),
            self.points_model.detach(),
            self.K.detach(),
            self.valid,
            self.weights.detach(),
        )

    def only(self, mask: Tensor) -> "PnpProblem":
        """The same problems with weights of zero outside of a mask (B, N)."""
        return replace(self, weights=self.weights * mask)

    def clean(self) -> tuple["PnpProblem", Tensor]:
        """The same problems without what cannot be computed with, and which intrinsics have an inverse (B,).

        Correspondences stay valid whose weight is positive and whose numbers are finite and not too large to be
        squared; those of the others become zeros. The identity stands in for intrinsics without inverse.
        """
        bound = torch.linalg.vector_norm(self.K.detach(), dim=-1).prod(-1)
        # Hadamard's inequality bounds the determinant by the product of the rows' lengths.
        rounding = 8.0 * torch.finfo(bound.dtype).eps
        invertible = torch.isfinite(bound) & (torch.linalg.det(self.K.detach()).abs() > rounding * bound)
        K = torch.where(
            invertible[:, None, None], self.K, torch.eye(3, dtype=bound.dtype, device=bound.device)
        )
        sane = usable_coordinates(self.points_image) & usable_coordinates(self.points_model)
        sane = sane & usable_coordinates(pixel_rays(self.points_image.detach(), K.detach()))
        valid = self.valid & sane & (self.weights > 0) & torch.isfinite(self.weights)
        left_out = ~valid.unsqueeze(-1)
        problem = PnpProblem(
            self.points_image.masked_fill(left_out, 0.0),
            self.points_model.masked_fill(left_out, 0.0),
            K,
            valid,
            self.weights.masked_fill(~valid, 0.0),
        )
        return problem, invertible

    def rays(self) -> Tensor:
        """Rays (B, N, 3) through the pixels of a clean problem, z = 1; their rounding does not depend on B."""
        # Written out, where pixel_rays has a matrix product.
        inverse = torch.linalg.inv(self.K).unsqueeze(1)
        u, v = self.points_image[..., :1], self.points_image[..., 1:]
        return inverse[..., 0] * u + inverse[..., 1] * v + inverse[..., 2]


class MinimalSolution(NamedTuple):
    """Poses from a minimal solver.

    Attributes:
        T_camera_from_model: (B, 4, 4), always finite.
        valid: (B,) bool, the points determine a pose and it has all of them in front of the camera.
        degenerate: (B,) bool, the points do not determine a pose: fewer than four, collinear or coincident ones, one
            pixel for all (of exactly four: for any two), or intrinsics without inverse. The pose is the identity.
    """

    T_camera_from_model: Tensor
    valid: Tensor
    degenerate: Tensor


def usable_coordinates(points: Tensor) -> Tensor:
    """Which points (..., d) are numbers whose fourth powers do not overflow: a bool mask (...)."""
    return (points.abs() < torch.finfo(points.dtype).max ** 0.25).all(-1)

"""Where the patches of a picture lie."""

import math
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.geometry.cameras import pixel_grid

PixelsT = TypeVar("PixelsT", float, Tensor)


class PatchGrid(NamedTuple):
    """A square grid of patches: patch (row, column) is centred at pixel ``stride · (column, row) + offset``.

    Attributes:
        stride: distance of neighbouring patch centres in pixels.
        offset: pixel coordinate of the first patch centre (integer coordinates are pixel centres).
        size: number of patches along a side.
    """

    stride: float
    offset: float
    size: int

    @classmethod
    def of_picture(cls, stride: float, offset: float, side: int) -> "PatchGrid":
        """As many patches as fit in a picture of ``side`` pixels, as far from its end as from its beginning."""
        return cls(stride, offset, max(0, math.floor((side - 1 - 2 * offset) / stride + 1e-6) + 1))

    def centers(self, device: torch.device, dtype: torch.dtype) -> Tensor:
        """Pixel coordinates (size, size, 2) of the patch centres as ``(u, v)``."""
        return pixel_grid(self.size, self.size, device, dtype) * self.stride + self.offset

    def to_map(self, pixels: PixelsT) -> PixelsT:
        """Pixels in the grid's own coordinates, in which patch (row, column) lies at ``(column, row)``."""
        return (pixels - self.offset) / self.stride

    def map_intrinsics(self, K: Tensor) -> Tensor:
        """Intrinsics (..., 3, 3) that project into the grid's own coordinates, from those that do into pixels."""
        shift = K[..., 2:, :] * self.offset
        return torch.cat([(K[..., :2, :] - shift) / self.stride, K[..., 2:, :]], dim=-2)

    def pixels_of(self, cells: Tensor, dtype: torch.dtype) -> Tensor:
        """Pixel coordinates (..., 2) of the centres of patches (...), counted row by row."""
        columns_rows = torch.stack([cells % self.size, cells // self.size], dim=-1)
        return columns_rows.to(dtype) * self.stride + self.offset

    def sample(self, pictures: Tensor) -> Tensor:
        """What square pictures (B, C, S, S) show at the patch centres, bilinearly: (B, C, size, size).

        Differentiable w.r.t. the pictures.
        """
        centers = self.centers(pictures.device, pictures.dtype)
        positions = (2 * centers + 1) / pictures.shape[-1] - 1
        return F.grid_sample(pictures, positions.expand(len(pictures), -1, -1, -1), align_corners=False)

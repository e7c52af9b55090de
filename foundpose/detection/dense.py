"""Descriptors of all patches of a picture."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.features import PatchExtractor
from foundpose.features.resample import sample_cells
from foundpose.geometry import pixel_grid


class DescriptorMap(NamedTuple):
    """Patch descriptors of whole pictures.

    Attributes:
        descriptors: (N, C, h, w); patch (row, column) is centred at pixel ``stride · (column, row) + offset``.
        stride: distance of neighbouring patches, pixels of the picture.
        offset: pixel coordinate of the first patch's centre.
    """

    descriptors: Tensor
    stride: float
    offset: float

    def share_of(self, masks: Tensor) -> Tensor:
        """What masks (P, H, W) show at the patch centres, bilinearly: (P, h, w) in [0, 1]."""
        height, width = self.descriptors.shape[-2:]
        centers = pixel_grid(height, width, masks.device, torch.float32) * self.stride + self.offset
        return sample_cells(masks[:, None].float(), centers, 1.0, 0.0)[:, 0]

    def to_masks(self, cells: Tensor, height: int, width: int) -> Tensor:
        """Masks (P, H, W) bool of regions (P, h, w) bool of patches, with edges half-way between patches."""
        pixels = pixel_grid(height, width, cells.device, torch.float32)
        return sample_cells(cells[:, None].float(), pixels, self.stride, self.offset)[:, 0] > 0.5


class DensePatches(nn.Module):
    """Describes a picture of any size in tiles of the size that an extractor is used at.

    The picture is enlarged first, since objects fill a small part of it and templates most of theirs. Tiles overlap:
    patches at a tile's edge, which see little of what surrounds them, are taken from its neighbour.

    Args:
        scales: enlargements of the picture; for each there is a map.
        size: side of a tile in pixels.
        margin: patches at a tile's edge that are left to its neighbours.
        batch_size: tiles that are described at a time.
    """

    def __init__(
        self, scales: Sequence[float] = (2.0,), size: int = 420, margin: int = 3, batch_size: int = 8
    ) -> None:
        super().__init__()
        if not isinstance(scales, Sequence) or not scales or not all(scale > 0 for scale in scales):
            raise ValueError(f"scales must be a list of positive numbers, such as [2.0], got {scales}")
        if margin < 0:
            raise ValueError(f"margin must be at least 0 patches, got {margin}")
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self.scales = tuple(scales)
        self.size = size
        self.margin = margin
        self.batch_size = batch_size

    def forward(self, images: Tensor, extractor: PatchExtractor) -> tuple[DescriptorMap, ...]:
        """Describe the patches of pictures (N, 3, H, W) in [0, 1]: a map for each scale.

        Raises:
            ValueError: the tiles are too small for their margin, or the extractor's stride is no whole number.

        Differentiable w.r.t. ``images`` and the extractor's parameters as far as the extractor is.
        """
        return tuple(self._describe(images, extractor, scale) for scale in self.scales)

    def _describe(self, images: Tensor, extractor: PatchExtractor, scale: float) -> DescriptorMap:
        grid = extractor.patch_grid(self.size)
        inner = grid.size - 2 * self.margin
        if inner < 1 or grid.stride != int(grid.stride):
            raise ValueError(
                f"tiles of {self.size} px have {grid.size} patches along a side, {grid.stride:g} px apart: margin "
                f"({self.margin}) must leave some, and the distance must be whole"
            )
        height, width = (round(side * scale) for side in images.shape[-2:])
        large = F.interpolate(
            images, (height, width), mode="bilinear", align_corners=False, antialias=scale < 1
        )
        # As many patches as fit, each described in the tile whose inner part it lies in.
        rows, columns = (
            max(1, math.floor((side - 1 - 2 * grid.offset) / grid.stride + 1e-6) + 1)
            for side in (height, width)
        )
        stride, before = int(grid.stride), self.margin * int(grid.stride)
        down, across = math.ceil(rows / inner), math.ceil(columns / inner)
        spans = [(count - 1) * inner * stride + self.size for count in (down, across)]
        padded = F.pad(
            large,
            (before, max(0, spans[1] - before - width), before, max(0, spans[0] - before - height)),
            mode="replicate",
        )[..., : spans[0], : spans[1]]
        step = inner * stride
        tiles = padded.unfold(2, self.size, step).unfold(3, self.size, step)
        tiles = tiles.permute(0, 2, 3, 1, 4, 5).flatten(0, 2)
        described = torch.cat([extractor(part).patches for part in tiles.split(self.batch_size)])
        last = self.margin + inner
        described = described[..., self.margin : last, self.margin : last]
        described = described.unflatten(0, (len(images), down, across)).permute(0, 3, 1, 4, 2, 5)
        joined = described.flatten(4, 5).flatten(2, 3)[..., :rows, :columns]
        return DescriptorMap(joined, grid.stride / scale, (grid.offset + 0.5) / scale - 0.5)

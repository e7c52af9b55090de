"""What every patch extractor provides."""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

from foundpose.geometry.patch_grid import PatchGrid

Fingerprint = dict[str, str | int | float | bool | None]


class PatchFeatures(NamedTuple):
    """Descriptors of the patches of a batch of images.

    Attributes:
        patches: (B, C, h, w) raw descriptors; cell (row, column) is centred at pixel
            ``(stride * column + offset, stride * row + offset)``.
        cls: (B, C) global descriptor, or None where the extractor has none.
    """

    patches: Tensor
    cls: Tensor | None


class PatchExtractor(nn.Module, ABC):
    """Maps square images to a regular grid of patch descriptors.

    Args:
        channels: length C of a descriptor.
        stride: distance of neighbouring patch centres in pixels.
        offset: pixel coordinate of the first patch centre (integer coordinates are pixel centres).

    Attributes:
        leaves_border: whether ``forward`` takes a second argument, the number of rows and columns of patches along
            each edge to leave out, which is less work: their descriptors are zero, and the others' do not depend on
            what is seen there.
    """

    leaves_border: bool = False

    def __init__(self, channels: int, stride: float, offset: float) -> None:
        super().__init__()
        self.channels = channels
        self.stride = stride
        self.offset = offset

    @abstractmethod
    def forward(self, images: Tensor) -> PatchFeatures:
        """Describe the patches of RGB images (B, 3, S, S) with values in [0, 1].

        Differentiable w.r.t. ``images`` and the extractor's parameters, unless a subclass says otherwise.
        """

    def border(self, size: int, fill: float, margin: int | None) -> int:
        """Rows and columns of patches along each edge of a picture that may be left out.

        Args:
            size: side of the picture in pixels.
            fill: share of it that the object fills, in the middle.
            margin: patches around that square that are described with it; None: all, so that none is left out.

        Raises:
            ValueError: a negative margin, or one though this extractor describes pictures as a whole only.
        """
        if margin is None:
            return 0
        if margin < 0:
            raise ValueError(f"margin must be at least 0, or null for whole pictures, got {margin}")
        if not self.leaves_border:
            raise ValueError(
                f"margin is {margin} but {type(self).__name__} describes pictures as a whole only; set margin=null"
            )
        outside = size * (1 - fill) / 2  # pixels
        return max(0, math.floor(outside / self.stride + 1e-6) - margin)

    def within(self, images: Tensor, border: int) -> PatchFeatures:
        """Describe pictures as :meth:`forward` does, but for a border of so many patches, see :meth:`border`."""
        features: PatchFeatures = self(images, border) if border else self(images)
        return features

    @abstractmethod
    def fingerprint(self) -> Fingerprint:
        """Settings that change the descriptors; an object representation is valid for one fingerprint only."""

    def running_precision(self) -> str | None:
        """Type that inference rounds to inside ("bf16", "fp16", "int8"); None for that of the weights.

        What was made in one type is not reused in another, though the fingerprint, and so what may be compared with
        what, is the same.
        """
        return None

    def patch_grid(self, image_size: int) -> PatchGrid:
        """Where the patches of an image of ``image_size`` pixels lie."""
        return PatchGrid.of_picture(self.stride, self.offset, image_size)

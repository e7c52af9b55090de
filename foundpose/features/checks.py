"""Checks that all patch extractors make of their input."""

import torch
from torch import Tensor

# Resampling may overshoot [0, 1] a little; 0..255 images and images normalised already are far outside.
_LOWEST, _HIGHEST = -0.5, 1.5


def check_images(images: Tensor, multiple_of: int = 1) -> None:
    """Check that images are what a ``PatchExtractor`` takes.

    The range of values is looked at on the CPU only: elsewhere it would make the host wait for the device.

    Args:
        images: (B, 3, S, S) RGB in [0, 1], floating point.
        multiple_of: what S must be a multiple of, pixels.

    Raises:
        ValueError: wrong shape, type, size or range.
    """
    if images.ndim != 4 or images.shape[1] != 3 or images.shape[2] != images.shape[3]:
        raise ValueError(f"images must have shape (B, 3, S, S), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise ValueError(f"images must be floating point in [0, 1], got {images.dtype}; divide by 255 first")
    size = images.shape[-1]
    if size == 0 or size % multiple_of:
        lower = size - size % multiple_of
        raise ValueError(
            f"the side of images must be a positive multiple of {multiple_of} px, got {size}; "
            f"crop or resize to {lower or multiple_of} or {lower + multiple_of} px"
        )
    if images.device.type == "cpu" and images.numel() and not torch.compiler.is_compiling():
        low, high = (float(x) for x in torch.aminmax(images.detach()))
        if low < _LOWEST or high > _HIGHEST:
            raise ValueError(
                f"images must hold RGB values in [0, 1], got values in [{low:g}, {high:g}]; "
                "divide 0..255 images by 255, and leave the normalisation to the extractor"
            )

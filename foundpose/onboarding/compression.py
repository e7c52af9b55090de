"""Templates as 8-bit or 16-bit pictures, and their lossless compression: Pillow writes no RGB of 16 bits."""

import zlib
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

_FILE_TYPES: dict[int, np.dtype[np.unsignedinteger]] = {8: np.dtype("u1"), 16: np.dtype("<u2")}
# PyTorch computes little with 16 bits without a sign.
_TENSOR_TYPES = {8: torch.uint8, 16: torch.int32}
# Higher levels take several times as long and save a tenth; cropping to the object and taking the differences of rows
# saves a fifth.
_FAST = 1


class PackedPictures(NamedTuple):
    """Compressed pictures with their masks, one stream of bytes per picture.

    Attributes:
        streams: (n,) uint8, all streams one after another.
        offsets: (N + 1,) int64; picture i owns bytes ``offsets[i]`` to ``offsets[i + 1]``.
    """

    streams: Tensor
    offsets: Tensor


def quantize(rgb: Tensor, bits: int) -> Tensor:
    """Round colours in [0, 1] to integers in [0, 2^bits − 1], as a camera does; uint8 or, for 16 bits, int32."""
    return (rgb * (2**bits - 1)).round_().to(_TENSOR_TYPES[bits])


def dequantize(levels: Tensor, bits: int) -> Tensor:
    """Colours in [0, 1], float32, of integers in [0, 2^bits − 1]."""
    return levels.to(torch.float32) / (2**bits - 1)


def pack_pictures(levels: Tensor, masks: Tensor, bits: int) -> PackedPictures:
    """Compress pictures losslessly.

    Args:
        levels: (N, 3, H, W) integers in [0, 2^bits − 1].
        masks: (N, H, W) bool.
        bits: 8 or 16.
    """
    arrays = levels.cpu().numpy().astype(_FILE_TYPES[bits])
    streams = [
        zlib.compress(picture.tobytes() + np.packbits(mask).tobytes(), _FAST)
        for picture, mask in zip(arrays, masks.cpu().numpy(), strict=True)
    ]
    sizes = torch.tensor([0, *map(len, streams)])
    return PackedPictures(torch.frombuffer(bytearray(b"".join(streams)), dtype=torch.uint8), sizes.cumsum(0))


def join_pictures(parts: list[PackedPictures]) -> PackedPictures:
    """Put packed pictures one after another."""
    sizes = torch.cat([part.offsets.diff() for part in parts])
    return PackedPictures(
        torch.cat([part.streams for part in parts]),
        torch.cat([sizes.new_zeros(1), sizes.cumsum(0)]),
    )


def unpack_pictures(
    packed: PackedPictures, rows: slice, size: tuple[int, int], bits: int
) -> tuple[Tensor, Tensor]:
    """Decompress some pictures.

    Args:
        packed: compressed by :func:`pack_pictures`.
        rows: which pictures.
        size: (height, width) of a picture.
        bits: 8 or 16, as when they were packed.

    Returns:
        Integers (n, 3, H, W), in the type of :func:`quantize`, and masks (n, H, W), on the CPU.
    """
    chosen = range(*rows.indices(len(packed.offsets) - 1))
    offsets = packed.offsets.tolist()
    levels = torch.zeros(len(chosen), 3, *size, dtype=_TENSOR_TYPES[bits])
    masks = torch.zeros(len(chosen), *size, dtype=torch.bool)
    for picture, mask, i in zip(levels.numpy(), masks.numpy(), chosen, strict=True):
        content = zlib.decompress(packed.streams[offsets[i] : offsets[i + 1]].numpy().data)
        colours = np.frombuffer(content, _FILE_TYPES[bits], picture.size)
        picture[:] = colours.reshape(picture.shape)
        bitmap = np.frombuffer(content, np.uint8, offset=colours.nbytes)
        mask[:] = np.unpackbits(bitmap, count=mask.size).reshape(mask.shape)
    return levels, masks

"""Templates as 8-bit or 16-bit pictures, and their lossless compression: Pillow writes no RGB of 16 bits."""

import zlib
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_ARRAY_TYPES: dict[int, type[np.unsignedinteger]] = {8: np.uint8, 16: np.uint16}
# PyTorch computes little with 16 bits without a sign.
_TENSOR_TYPES = {8: torch.uint8, 16: torch.int32}
# Higher levels take several times as long and save a tenth.
_FAST = 1


class PackedPictures(NamedTuple):
    """Compressed pictures with their masks, one stream of bytes per picture.

    Attributes:
        boxes: (N, 4) int32 ``(top, left, height, width)``: what lies outside is black and not in the mask.
        streams: (n,) uint8, all streams one after another.
        offsets: (N + 1,) int64; picture i owns bytes ``offsets[i]`` to ``offsets[i + 1]``.
    """

    boxes: Tensor
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
    arrays = levels.cpu().numpy().astype(_ARRAY_TYPES[bits])
    boxes, streams = [], []
    for picture, mask in zip(arrays, masks.cpu().numpy(), strict=True):
        # Anti-aliased pixels lie beside the mask.
        top, left, height, width = box = _bounding_box(mask | picture.any(axis=0))
        inside = np.s_[..., top : top + height, left : left + width]
        content = _to_bytes(picture[inside]) + np.packbits(mask[inside]).tobytes()
        boxes.append(box)
        streams.append(zlib.compress(content, _FAST))
    sizes = torch.tensor([0, *map(len, streams)])
    joined = torch.frombuffer(bytearray(b"".join(streams)), dtype=torch.uint8)
    return PackedPictures(torch.tensor(boxes, dtype=torch.int32), joined, sizes.cumsum(0))


def join_pictures(parts: list[PackedPictures]) -> PackedPictures:
    """Put packed pictures one after another."""
    sizes = torch.cat([part.offsets.diff() for part in parts])
    return PackedPictures(
        torch.cat([part.boxes for part in parts]),
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
    chosen = range(*rows.indices(len(packed.boxes)))
    dtype = np.dtype(_ARRAY_TYPES[bits])
    levels = torch.zeros(len(chosen), 3, *size, dtype=_TENSOR_TYPES[bits])
    masks = np.zeros((len(chosen), *size), np.bool_)
    offsets = packed.offsets.tolist()
    for picture, mask, i in zip(levels.numpy(), masks, chosen, strict=True):
        top, left, height, width = packed.boxes[i].tolist()
        inside = np.s_[..., top : top + height, left : left + width]
        stream = packed.streams[offsets[i] : offsets[i + 1]]
        content = zlib.decompress(stream.numpy().data)
        count = 3 * height * width * dtype.itemsize
        picture[inside] = _from_bytes(content[:count], (3, height, width), dtype)
        bitmap = np.frombuffer(content[count:], np.uint8)
        mask[inside] = np.unpackbits(bitmap, count=height * width).reshape(height, width)
    return levels, torch.from_numpy(masks)


def _bounding_box(occupied: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """(top, left, height, width) of what is True; zeros where nothing is."""
    rows, columns = np.flatnonzero(occupied.any(axis=1)), np.flatnonzero(occupied.any(axis=0))
    if len(rows) == 0:
        return 0, 0, 0, 0
    top, left = int(rows[0]), int(columns[0])
    return top, left, int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left


def _to_bytes(picture: NDArray[np.unsignedinteger]) -> bytes:
    """Differences from the row above (modulo 2^bits), low bytes and high bytes apart: what compresses well."""
    above = np.diff(picture, axis=1, prepend=picture.dtype.type(0))
    little = np.ascontiguousarray(above.astype(above.dtype.newbyteorder("<"), copy=False))
    return little.view(np.uint8).reshape(-1, above.itemsize).T.tobytes()


def _from_bytes(
    content: bytes, shape: tuple[int, int, int], dtype: np.dtype[np.unsignedinteger]
) -> NDArray[np.unsignedinteger]:
    """Inverse of :func:`_to_bytes`."""
    planes = np.frombuffer(content, np.uint8).reshape(dtype.itemsize, -1)
    above = np.ascontiguousarray(planes.T).view(dtype.newbyteorder("<")).reshape(shape).astype(dtype)
    return np.cumsum(above, axis=1, dtype=dtype)

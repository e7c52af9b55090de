"""Masks of detections: COCO's run lengths and polygons."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from pycocotools import mask as coco_mask
from torch import Tensor

from foundpose.bop.files import BopError

# COCO's code of numbers, in up to six characters each. On other strings pycocotools reads memory that is not its own.
_RUN_LENGTHS = re.compile(rb"(?:[P-o]{0,5}[0-O])+")


def pack_segmentation(segmentation: Any) -> dict[str, Any] | list[list[float]]:
    """A COCO segmentation as it is kept: run lengths packed to bytes, or polygons.

    Args:
        segmentation: ``{"size": [height, width], "counts": …}`` with run lengths as COCO's string, as a list or as
            numbers with spaces between; or a list of polygons ``[x1, y1, x2, y2, …]`` in pixels.

    Raises:
        BopError: neither.
    """
    if isinstance(segmentation, Sequence) and not isinstance(segmentation, str):
        return _checked_polygons(segmentation)
    if not isinstance(segmentation, Mapping) or not {"size", "counts"} <= segmentation.keys():
        raise BopError(
            "not a COCO segmentation: {'size': [height, width], 'counts': run lengths} or a list of polygons; "
            f"got {str(segmentation)[:60]}"
        )
    size, counts = segmentation["size"], segmentation["counts"]
    if not isinstance(size, Sequence) or len(size) != 2 or not all(type(n) is int and n > 0 for n in size):
        raise BopError(f"size must be [height, width], got {size!r}")
    height, width = size
    if isinstance(counts, str):
        if " " in counts.strip() and counts.replace(" ", "").isdecimal():
            counts = [int(number) for number in counts.split()]
        else:
            counts = counts.encode()
    if isinstance(counts, list):
        if not all(type(value) is int and value >= 0 for value in counts):
            raise BopError("counts must be whole numbers of at least 0")
        if sum(counts) != height * width:
            raise BopError(f"run lengths cover {sum(counts)} pixels, the size says {height}x{width}")
        counts = coco_mask.frPyObjects({"size": [height, width], "counts": counts}, height, width)["counts"]
    if not isinstance(counts, bytes):
        raise BopError(f"counts must be a string or a list, got {type(counts).__name__}")
    if _RUN_LENGTHS.fullmatch(counts) is None:
        raise BopError("counts is cut off, or holds characters that do not belong into COCO's run lengths")
    return {"size": [height, width], "counts": counts}


def decode_segmentation(segmentation: Any, size: tuple[int, int] | None = None) -> Tensor:
    """Decode a COCO segmentation, see :func:`pack_segmentation`, to (H, W) bool.

    Args:
        segmentation: run lengths or polygons.
        size: (height, width) of its image, which polygons need and run lengths must have.

    Raises:
        BopError: not a segmentation, or one of another size than its image.
    """
    packed = pack_segmentation(segmentation)
    if isinstance(packed, list):
        if size is None:
            raise BopError("polygons need the size of their image")
        packed = coco_mask.merge(coco_mask.frPyObjects(packed, *size))
    height, width = packed["size"]
    if size is not None and (height, width) != tuple(size):
        swapped = (width, height) == tuple(size)
        hint = "; COCO's size is [height, width], not [width, height]" if swapped else ""
        raise BopError(f"a mask of {width}x{height} px, the image has {size[1]}x{size[0]} px{hint}")
    if _fits(packed["counts"], height * width - 1) or not _fits(packed["counts"], height * width):
        raise BopError(f"run lengths do not cover the {height}x{width} pixels that the size says")
    return torch.from_numpy(np.ascontiguousarray(coco_mask.decode(packed))).bool()


def _fits(counts: bytes, pixels: int) -> bool:
    """Whether run lengths cover no more than some pixels: pycocotools refuses those that do."""
    try:
        coco_mask.decode({"size": [pixels, 1], "counts": counts})
    except ValueError:
        return False
    return True


def _checked_polygons(polygons: Sequence[Any]) -> list[list[float]]:
    for polygon in polygons:
        if (
            not isinstance(polygon, Sequence)
            or len(polygon) < 6
            or len(polygon) % 2
            or not all(type(n) in (int, float) and abs(n) < 1e6 for n in polygon)
        ):
            raise BopError(
                f"a polygon must be [x1, y1, x2, y2, x3, y3, …] in pixels, got {str(polygon)[:60]} of "
                f"{type(polygon).__name__}"
            )
    if not polygons:
        raise BopError("the list of polygons is empty")
    return [list(map(float, polygon)) for polygon in polygons]


def encode_segmentation(mask: Tensor) -> dict[str, Any]:
    """COCO's run lengths of a mask (H, W) bool, as the string that JSON holds."""
    packed = coco_mask.encode(np.asfortranarray(mask.cpu().numpy().astype(np.uint8)))
    return {"size": list(packed["size"]), "counts": packed["counts"].decode()}

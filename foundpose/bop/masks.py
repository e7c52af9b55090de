"""Masks of objects: reading them, and noticing those that are probably not what was meant."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from foundpose.utils.pictures import PictureError, check_size, read_picture
from foundpose.utils.warn import warn_caller

# Beyond this share of a picture a mask is rather the picture itself, or what is not the object.
_NEARLY_ALL = 0.9
# Pieces are too far apart if the box around all is so many times as large as that of the largest; or, where all but
# the largest are stray pixels (a tenth of the mask at most), twice as large. Of LM-O's 365 visible masks, of objects
# that others hide in part, this holds for two, whose other pieces have 8 and 35 pixels.
_FAR, _STRAY, _FAR_STRAY = 4.0, 0.1, 2.0


def read_mask(
    path: str | Path,
    size: tuple[int, int] | None = None,
    largest_component: bool = True,
    checked: bool = True,
) -> Tensor:
    """Read a mask as (H, W) bool.

    Of a picture whose alpha varies (a cut-out), alpha is the mask: True where more than half opaque. Of others, True
    where any channel is above half of the range.

    Args:
        path: a picture.
        size: expected (height, width).
        largest_component: of pieces that lie far apart, return the largest alone; see :func:`plausible_mask`.
        checked: refuse an empty mask, and warn of one that is hardly an object's. False returns what the file holds.

    Raises:
        FileNotFoundError: no such file.
        PictureError: not a picture, one of another size, or an empty mask.
    """
    picture = read_picture(path)
    brightness = picture.rgb.amax(dim=0)
    if picture.alpha is not None and bool((picture.alpha != picture.alpha[0, 0]).any()):
        brightness = picture.alpha
    mask = brightness > 0.5
    if checked and not bool(mask.any()):
        raise PictureError(
            f"the mask {path} is empty: no pixel is above half of the range (the brightest is "
            f"{round(float(brightness.max()) * 255)} of 255; a mask of zeros and ones must be multiplied by 255)"
        )
    check_size(f"the mask {path}", mask, size)
    return plausible_mask(mask, f"the mask {path}", largest_component) if checked else mask


def largest_component(mask: Tensor) -> Tensor:
    """The largest piece of a mask (H, W) bool; pixels that touch at a corner belong together."""
    from scipy import ndimage  # slow to import, and few masks need it

    box = _box(mask)
    inside = mask[box].cpu().numpy()
    pieces, count = ndimage.label(inside, structure=np.ones((3, 3)))
    if count < 2:
        return mask
    largest = torch.zeros_like(mask)
    largest[box] = torch.from_numpy(pieces == 1 + np.bincount(pieces.ravel())[1:].argmax()).to(mask.device)
    return largest


def plausible_mask(mask: Tensor, name: str, keep_largest: bool = True) -> Tensor:
    """A mask as it should be used for a crop, with a warning where it is hardly one object's.

    Warned of are masks that cover more than nine tenths of the picture or all of its border (the share is named),
    and masks whose pieces lie so far apart that the box around them has more than four times the area of the largest
    piece's box, or twice if the others are stray pixels. Pieces that lie closer together are an object that something
    hides in part, and are left alone.

    Args:
        mask: (H, W) bool.
        name: what to call it in a warning.
        keep_largest: of pieces that are far apart, return the largest alone.

    Returns:
        (H, W) bool.
    """
    share = float(mask.float().mean())
    border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean()
    if share > _NEARLY_ALL or (share > 0.5 and border > _NEARLY_ALL):
        warn_caller(
            f"{name} covers {share:.1%} of the picture, {float(border):.0%} of its border: is it inverted? "
            "A mask is bright (or opaque) on the object"
        )
    largest = largest_component(mask)
    growth = mask[_box(mask)].numel() / max(largest[_box(largest)].numel(), 1)
    outside = 1.0 - float(largest.sum()) / max(float(mask.sum()), 1.0)
    if growth <= (_FAR_STRAY if outside <= _STRAY else _FAR):
        return mask
    left = (
        "all are kept" if not keep_largest else "the others are left out (largest_component=false keeps them)"
    )
    warn_caller(
        f"{name} has pieces far apart: the largest has {int(largest.sum())} of {int(mask.sum())} pixels, the box "
        f"around all is {growth:.1f} times as large as its own; {left}"
    )
    return largest if keep_largest else mask


def _box(mask: Tensor) -> tuple[slice, slice]:
    """Rows and columns of the box around a mask."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if not len(rows):
        return slice(0), slice(0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

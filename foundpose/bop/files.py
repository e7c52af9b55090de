"""Reading the files of a BOP dataset, with errors that say what is wrong."""

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor


class BopError(ValueError):
    """A BOP dataset or file is not as the format demands."""


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        FileNotFoundError: no such file; the message lists what its folder holds.
        BopError: not JSON.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; {describe_folder(path.parent)}")
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BopError(f"{path} is not valid JSON: {error}") from error


def describe_folder(folder: Path, most: int = 12) -> str:
    """Say in words what a folder holds."""
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    if not names:
        return f"the folder {folder} is empty"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{folder} holds {', '.join(names[:most])}{more}"


def read_image(path: str | Path) -> Tensor:
    """Read a picture as (3, H, W) float32 RGB in [0, 1]; grey becomes RGB, alpha is dropped, 16 bit is scaled.

    Raises:
        FileNotFoundError: no such file.
        BopError: not a picture.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}; {describe_folder(path.parent)}")
    try:
        array = np.asarray(iio.imread(path))
    except (OSError, ValueError, SyntaxError) as error:
        raise BopError(f"{path} is not a readable image: {error}") from error
    if array.dtype.kind == "b":
        array = array.astype(np.uint8) * 255
    if array.dtype.kind != "u" or array.ndim not in (2, 3):
        raise BopError(f"{path} is no 8 or 16 bit image (got {array.dtype}, shape {array.shape})")
    pixels = torch.from_numpy(array.astype(np.float32) / np.iinfo(array.dtype).max)
    if pixels.dim() == 2:
        pixels = pixels.unsqueeze(-1)
    if pixels.shape[-1] in (1, 2):
        pixels = pixels[..., :1].expand(-1, -1, 3)
    return pixels[..., :3].permute(2, 0, 1).contiguous()


def read_mask(path: str | Path, size: tuple[int, int] | None = None, may_be_empty: bool = False) -> Tensor:
    """Read a mask as (H, W) bool: True where any channel is above half of the range.

    Args:
        path: a picture.
        size: expected (height, width).
        may_be_empty: accept a mask without a bright pixel.

    Raises:
        FileNotFoundError: no such file.
        BopError: not a picture, one of another size, or (unless ``may_be_empty``) one without a bright pixel.
    """
    mask = read_image(path).amax(dim=0) > 0.5
    if not may_be_empty and not bool(mask.any()):
        brightest = round(float(read_image(path).max()) * 255)
        raise BopError(
            f"the mask {path} is empty: no pixel is above half of the range (the brightest is {brightest} of 255)"
        )
    if size is not None and tuple(mask.shape) != tuple(size):
        raise BopError(
            f"the mask {path} is {mask.shape[1]}x{mask.shape[0]} px, its image {size[1]}x{size[0]} px"
        )
    return mask

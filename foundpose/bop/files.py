"""Reading the files of a BOP dataset, with errors that say what is wrong."""

import json
from collections.abc import Iterator
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
        BopError: not JSON; the message gives line and column.
    """
    text = _read_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise BopError(f"{path} is not valid JSON: {error}") from error


def iterate_json_list(path: Path) -> Iterator[Any]:
    """The entries of a JSON file that holds a list, one after the other; only one exists as objects at a time.

    A file of detections is some hundred megabytes of run lengths, and ten times that as Python objects.

    Raises:
        FileNotFoundError: no such file; the message lists what its folder holds.
        BopError: not JSON, or no list; the message gives line and column.
    """
    text = _read_text(path)
    decoder = json.JSONDecoder()

    def skip_space(position: int) -> int:
        while text[position : position + 1] in (" ", "\t", "\n", "\r"):
            position += 1
        return position

    position = skip_space(0)
    if text[position : position + 1] not in ("[", ""):
        raise BopError(f"{path} must hold a JSON list, it starts with {text[position : position + 20]!r}")
    try:
        if position == len(text):
            raise json.JSONDecodeError("Expecting value", text, position)
        position = skip_space(position + 1)
        first = True
        while text[position : position + 1] != "]":
            if not first:
                if text[position : position + 1] != ",":
                    raise json.JSONDecodeError("Expecting ',' delimiter", text, position)
                position = skip_space(position + 1)
            first = False
            entry, position = decoder.raw_decode(text, position)
            yield entry
            position = skip_space(position)
        if skip_space(position + 1) != len(text):
            raise json.JSONDecodeError("Extra data", text, position + 1)
    except json.JSONDecodeError as error:
        raise BopError(f"{path} is not valid JSON: {error}") from error


def _read_text(path: Path) -> str:
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; {describe_folder(path.parent)}")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BopError(f"{path} is not valid JSON: {error}") from error


class JsonCache:
    """Contents of the JSON files read last; a file that has changed is read again.

    Args:
        max_bytes: size on disk of the files kept. The file read last is kept whatever its size.
    """

    def __init__(self, max_bytes: int = 32 * 2**20) -> None:
        self.max_bytes = max_bytes
        self._entries: dict[Path, tuple[tuple[int, int, int], Any]] = {}

    def read(self, path: Path) -> Any:
        """Content of a file, not to be changed by the caller. Raises as :func:`read_json`."""
        if not path.is_file():
            self._entries.pop(path, None)
            return read_json(path)
        stat = path.stat()
        state = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        # Taken out and put back at the end, so that the order is that of use.
        entry = self._entries.pop(path, None)
        if entry is None or entry[0] != state:
            entry = (state, read_json(path))
        self._entries[path] = entry
        while len(self._entries) > 1 and sum(kept[1] for kept, _ in self._entries.values()) > self.max_bytes:
            self._entries.pop(next(iter(self._entries)))
        return entry[1]

    def __getstate__(self) -> dict[str, Any]:
        # Workers of a data loader read for themselves.
        return {"max_bytes": self.max_bytes, "_entries": {}}


def describe_folder(folder: Path, most: int = 12) -> str:
    """Say in words what a folder holds."""
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    if not names:
        return f"the folder {folder} is empty"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{folder} holds {', '.join(names[:most])}{more}"


def _read_pixels(path: Path) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}; {describe_folder(path.parent)}")
    try:
        return np.asarray(iio.imread(path))
    except (OSError, ValueError, SyntaxError) as error:
        raise BopError(f"{path} is not a readable image: {error}") from error


def read_image(path: str | Path) -> Tensor:
    """Read a picture as (3, H, W) float32 RGB in [0, 1]; grey becomes RGB, alpha is dropped, 16 bit is scaled.

    Raises:
        FileNotFoundError: no such file.
        BopError: not a picture.
    """
    array = _read_pixels(Path(path))
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


def read_image_size(path: Path) -> tuple[int, int]:
    """(height, width) of a picture in pixels, from the file's header.

    Raises:
        BopError: not a picture.
    """
    try:
        shape = iio.improps(path).shape
    except (OSError, ValueError, SyntaxError) as error:
        raise BopError(f"{path} is not a readable image: {error}") from error
    return int(shape[0]), int(shape[1])


def read_depth(path: str | Path, scale: float, size: tuple[int, int] | None = None) -> Tensor:
    """Read a depth image (png or tif, 16 bit or more) as (H, W) float32: value times ``scale``.

    Args:
        path: a depth image.
        scale: BOP's ``depth_scale``, which makes millimetres of the values.
        size: expected (height, width).

    Raises:
        FileNotFoundError: no such file.
        BopError: not a depth image, one with values below zero or not finite, or one of another size.
    """
    array = _read_pixels(Path(path))
    if array.ndim != 2 or array.dtype.kind not in "uif" or array.dtype.itemsize < 2:
        raise BopError(
            f"{path} is no depth image, which has one channel of 16 bit (got {array.dtype}, shape {array.shape})"
        )
    depth = torch.from_numpy(array.astype(np.float32)) * scale
    if not bool((torch.isfinite(depth) & (depth >= 0)).all()):
        raise BopError(f"the depth image {path} has values that are negative or not finite")
    if size is not None and tuple(depth.shape) != tuple(size):
        raise BopError(
            f"the depth image {path} is {depth.shape[1]}x{depth.shape[0]} px, its image {size[1]}x{size[0]} px"
        )
    return depth


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
    brightness = read_image(path).amax(dim=0)
    mask = brightness > 0.5
    if not may_be_empty and not bool(mask.any()):
        raise BopError(
            f"the mask {path} is empty: no pixel is above half of the range (the brightest is "
            f"{round(float(brightness.max()) * 255)} of 255)"
        )
    if size is not None and tuple(mask.shape) != tuple(size):
        raise BopError(
            f"the mask {path} is {mask.shape[1]}x{mask.shape[0]} px, its image {size[1]}x{size[0]} px"
        )
    return mask

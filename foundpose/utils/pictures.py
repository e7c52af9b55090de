"""Picture files of any kind, as what they show: RGB in [0, 1], upright, and alpha."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import ExifTags, Image, ImageColor, ImageOps, UnidentifiedImageError
from torch import Tensor

from foundpose.utils.files import describe_folder

# Pillow's modes of 8 bits that it converts to RGB or RGBA as a viewer does.
_PLAIN = ("1", "L", "P", "RGB", "RGBX", "CMYK", "YCbCr", "HSV")
_WITH_ALPHA = ("LA", "La", "PA", "RGBA", "RGBa")
_TURNED = (5, 6, 7, 8)
_EXIF_ENTRIES = {"exif", "Raw profile type exif", "xmp", "XML:com.adobe.xmp"}


class PictureError(ValueError):
    """A file is no picture that can be used."""


class Picture(NamedTuple):
    """What a file shows, after its EXIF orientation has been applied.

    Attributes:
        rgb: (3, H, W) float32 in [0, 1], as stored below alpha.
        alpha: (H, W) float32 in [0, 1]; None where the file has none.
    """

    rgb: Tensor
    alpha: Tensor | None

    def over(self, background: str) -> Tensor:
        """RGB (3, H, W) over a colour that shows where the picture is transparent.

        Args:
            background: a name such as "black", or "#808080".

        Raises:
            ValueError: no colour.
        """
        try:
            colour = torch.tensor(ImageColor.getrgb(background)[:3]) / 255.0
        except ValueError as error:
            raise ValueError(
                f"background must be a colour such as black or #808080, got {background!r}"
            ) from error
        if self.alpha is None:
            return self.rgb
        return self.alpha * self.rgb + (1.0 - self.alpha) * colour[:, None, None]


def read_picture(path: str | Path) -> Picture:
    """Read a picture.

    Grey, palette, CMYK, YCbCr, HSV and 1 bit become RGB; 16 bits are scaled by 65535; floats must lie in [0, 1]. What
    a file is depends on its content, not on its ending.

    Raises:
        FileNotFoundError: no such file.
        PictureError: not a picture, a damaged one, several in one file, or colours whose range is not known.
    """
    with _opened(Path(path)) as image:
        frames = getattr(image, "n_frames", 1)
        # Telephones write MPO: a picture, and others for the depth or the preview.
        if frames > 1 and image.format != "MPO":
            raise PictureError(f"{path} holds {frames} pictures ({image.format}); save the one that is meant")
        return convert_picture(image, path)


def convert_picture(image: Image.Image, path: str | Path) -> Picture:
    """What a picture that Pillow has opened shows, see :func:`read_picture`; ``path`` is for messages."""
    ImageOps.exif_transpose(image, in_place=True)
    if image.mode in _WITH_ALPHA or (image.mode in _PLAIN and "transparency" in image.info):
        pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255.0
    elif image.mode in _PLAIN:
        pixels = np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0
    else:
        pixels = np.repeat(_deep(image, path)[..., None], 3, axis=2)
    values = torch.from_numpy(pixels).permute(2, 0, 1).contiguous()
    return Picture(values[:3], values[3] if len(values) == 4 else None)


def read_image(path: str | Path, background: str = "black") -> Tensor:
    """Read a picture as (3, H, W) float32 RGB in [0, 1], upright, see :func:`read_picture`.

    Args:
        path: a picture file.
        background: colour that shows where the picture is transparent.

    Raises:
        FileNotFoundError: no such file.
        PictureError: not a picture that can be used.
        ValueError: ``background`` is no colour.
    """
    return read_picture(path).over(background)


def read_image_size(path: str | Path) -> tuple[int, int]:
    """(height, width) of a picture in pixels as it is read, from the file's header.

    Raises:
        FileNotFoundError: no such file.
        PictureError: not a picture.
    """
    with _opened(Path(path)) as image:
        width, height = image.size
        # Pillow turns TIFF itself. It decodes a PNG without EXIF whole to look for some at the end.
        may_turn = image.format != "TIFF" and not _EXIF_ENTRIES.isdisjoint(image.info)
        turned = may_turn and image.getexif().get(ExifTags.Base.Orientation) in _TURNED
    return (width, height) if turned else (height, width)


def read_depth(path: str | Path, scale: float, size: tuple[int, int] | None = None) -> Tensor:
    """Read a depth image (png or tif, 16 bit or more) as (H, W) float32: value times ``scale``.

    Args:
        path: a depth image.
        scale: BOP's ``depth_scale``, which makes millimetres of the values.
        size: expected (height, width).

    Raises:
        FileNotFoundError: no such file.
        PictureError: not a depth image, one with values below zero or not finite, or one of another size.
    """
    with _opened(Path(path)) as image:
        if image.mode != "F" and not image.mode.startswith("I"):
            raise PictureError(
                f"{path} is no depth image, which has one channel of 16 bit (its mode is {image.mode!r})"
            )
        depth = torch.from_numpy(np.asarray(image).astype(np.float32)) * scale
    if not bool((torch.isfinite(depth) & (depth >= 0)).all()):
        raise PictureError(f"the depth image {path} has values that are negative or not finite")
    check_size(f"the depth image {path}", depth, size)
    return depth


def check_size(name: str, values: Tensor, size: tuple[int, int] | None) -> None:
    """Raise PictureError unless (H, W) values have a size, if one is given; say so if its sides are swapped."""
    if size is None or tuple(values.shape) == tuple(size):
        return
    hint = ""
    if tuple(values.shape) == tuple(size)[::-1]:
        hint = (
            ": width and height are swapped. Pictures are turned as their EXIF orientation says; turn this, and the "
            "intrinsics, likewise"
        )
    raise PictureError(
        f"{name} is {values.shape[1]}x{values.shape[0]} px, its image {size[1]}x{size[0]} px{hint}"
    )


def _deep(image: Image.Image, path: str | Path) -> np.ndarray:
    """Grey of more than 8 bits in [0, 1]: (H, W) float32."""
    values = np.asarray(image)
    # Of what Pillow reads as integers of unknown range, it scales PGM itself.
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PPM"):
        return values.astype(np.float32) / 65535.0
    if image.mode == "F":
        if not np.isfinite(values).all() or values.min() < 0.0 or values.max() > 1.0:
            raise PictureError(
                f"{path} holds floats from {values.min():.4g} to {values.max():.4g}; scale them to [0, 1]"
            )
        return values.astype(np.float32)
    raise PictureError(
        f"{path} has colours of mode {image.mode!r}, whose range is not known; save it as RGB or grey of 8 or 16 bits"
    )


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """A picture file; what Pillow raises while it is in use becomes a PictureError."""
    if str(path).startswith(("http:/", "https:/")):
        raise PictureError(f"{path} is an address; download the picture and name the file")
    path = path.expanduser()
    if path.is_dir():
        raise PictureError(f"{path} is a folder, not a picture; {describe_folder(path)}")
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}; {describe_folder(path.parent)}")
    if path.stat().st_size == 0:
        raise PictureError(f"{path} is not a readable image: the file is empty (0 bytes)")
    try:
        with Image.open(path) as image:
            yield image
    except PictureError:
        raise
    except UnidentifiedImageError as error:
        raise PictureError(
            f"{path} is not a readable image: Pillow does not know its format (save HEIC or camera raw as JPEG)"
        ) from error
    except Exception as error:  # decoders raise whatever damaged bytes lead them to
        raise PictureError(f"{path} is not a readable image: {error or type(error).__name__}") from error

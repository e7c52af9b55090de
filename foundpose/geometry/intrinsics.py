"""Intrinsics as people have them: lists, matrices and files of other tools, checked against the picture."""

import json
import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from torch import Tensor

from foundpose.geometry.cameras import intrinsics_matrix, resize_intrinsics
from foundpose.utils.warn import warn_caller

_FORM = "[fx,fy,cx,cy] in pixels, a 3x3 matrix, or a file (BOP's camera.json, a camera_info YAML of ROS)"
_FISHEYE = ("fisheye", "equidistant", "kannala", "omni", "division", "624", "mei")


class CameraError(ValueError):
    """Intrinsics that cannot be used, with the reason."""


class Camera(NamedTuple):
    """A pinhole camera with lens distortion.

    Attributes:
        K: (3, 3) float32 intrinsics in pixels; integer coordinates are pixel centres.
        distortion: OpenCV's coefficients; empty for none.
        size: (height, width) of its pictures in pixels, where it is known.
    """

    K: Tensor
    distortion: list[float]
    size: tuple[int, int] | None = None


def read_camera(intrinsics: object) -> Camera:
    """Intrinsics from [fx, fy, cx, cy], 9 numbers row by row, a 3 × 3 list, or a file.

    Files are BOP's ``camera.json``, an entry of its ``scene_camera.json`` (``cam_K``) and ROS's ``camera_info`` YAML
    (``plumb_bob`` and ``rational_polynomial``, whose coefficients are OpenCV's).

    Raises:
        FileNotFoundError: no such file.
        CameraError: something else, a fisheye camera, focal lengths that are not positive, a matrix that is none.
    """
    if isinstance(intrinsics, str | Path):
        return _read_file(Path(intrinsics).expanduser())
    return Camera(_matrix(intrinsics, "intrinsics"), [])


def check_camera(K: Tensor, size: tuple[int, int], of_size: tuple[int, int] | None = None) -> None:
    """Make sure that intrinsics belong to pictures of a size; warn where they hardly do.

    Args:
        K: (3, 3) in pixels.
        size: (height, width) of the picture.
        of_size: (height, width) that the intrinsics were made for, where it is known.

    Raises:
        CameraError: they were made for another size, or stand in another order than ``[fx, fy, cx, cy]``, or cannot
            be in pixels.
    """
    height, width = size
    fx, fy, cx, cy = K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()
    if of_size is not None and tuple(of_size) != tuple(size):
        raise CameraError(
            f"the intrinsics are for pictures of {of_size[1]}x{of_size[0]} px, the picture is {width}x{height} px"
            + _rescaled(K, width / of_size[1], height / of_size[0])
        )
    if _unlikely(fx, fy, cx, cy, size) > 0.5:
        for order, values in {
            "[fx,cx,fy,cy]": (fx, cx, fy, cy),
            "[cx,cy,fx,fy]": (cx, cy, fx, fy),
            "[cx,fx,cy,fy]": (fy, cy, fx, cx),
        }.items():
            if min(values) > 0 and _unlikely(*values, size) < 0.1:
                raise CameraError(
                    f"the intrinsics {_list(fx, fy, cx, cy)} look as if they stood in the order {order}: give "
                    f"intrinsics={_list(*values)}"
                )
    view = 2.0 * math.degrees(math.atan(0.5 * width / fx))
    if not 0.5 < view < 160.0:
        raise CameraError(
            f"fx={fx:.6g} px in a picture {width} px wide is a field of view of {view:.3g}°; a focal length in "
            "millimetres becomes pixels times the picture's width in pixels over the sensor's width in millimetres"
        )
    off_u, off_v = (cx - (width - 1) / 2) / width, (cy - (height - 1) / 2) / height
    if max(abs(off_u), abs(off_v)) > 0.2:
        warn_caller(
            f"the principal point ({cx:.6g}, {cy:.6g}) is far from the centre of the picture of {width}x{height} px"
            + _rescaled(K, width / max(2 * cx + 1, 1e-6), height / max(2 * cy + 1, 1e-6))
            + "; for a part cut out of a larger picture it may be right"
        )
    elif abs(math.log(fx) - math.log(fy)) > 0.2:
        warn_caller(f"focal lengths of fx={fx:.6g} and fy={fy:.6g} px mean pixels that are far from square")


def _unlikely(fx: float, fy: float, cx: float, cy: float, size: tuple[int, int]) -> float:
    """How far from an ordinary camera's intrinsics are: principal point off the centre, pixels not square."""
    off = max(abs(cx / size[1] - 0.5), abs(cy / size[0] - 0.5))
    return max(off, abs(math.log(fx) - math.log(fy)))


def _rescaled(K: Tensor, across: float, down: float) -> str:
    """What to give for a picture of another size, where one factor fits both sides."""
    if max(across, down) > 100 or not 0.95 < across / down < 1.05:
        return ""
    factor = 0.5 * (across + down)
    simple = float(Fraction(factor).limit_denominator(8))
    factor = simple if abs(simple / factor - 1.0) < 0.03 else factor
    scaled = resize_intrinsics(K, factor)
    values = _list(*(scaled[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))))
    return f". Are they of a picture {1 / factor:.3g} times as large? With the factor {factor:.4g} they are {values}"


def _list(*values: float) -> str:
    return "[" + ",".join(f"{value:.6g}" for value in values) + "]"


def _matrix(values: Any, name: str) -> Tensor:
    """K (3, 3) of 4 numbers, of 9, or of three rows of 3."""
    try:
        numbers = torch.tensor([[float(v) for v in row] if _is_list(row) else float(row) for row in values])
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise CameraError(f"{name} must be {_FORM}, got {values}") from error
    if not bool(torch.isfinite(numbers).all()) or numbers.shape not in ((4,), (9,), (3, 3)):
        raise CameraError(f"{name} must be {_FORM}, got {values}")
    K = intrinsics_matrix(*numbers.tolist()) if numbers.shape == (4,) else numbers.reshape(3, 3)
    if K[2].tolist() != [0.0, 0.0, 1.0] or K[1, 0] != 0:
        hint = "; it is transposed" if K[:, 2].tolist() == [0.0, 0.0, 1.0] else ""
        raise CameraError(
            f"{name} must be fx s cx 0 fy cy 0 0 1, row by row, got {K.flatten().tolist()}{hint}"
        )
    if min(K[0, 0].item(), K[1, 1].item()) <= 0:
        raise CameraError(
            f"focal lengths must be positive, got fx={K[0, 0].item():.6g}, fy={K[1, 1].item():.6g} (x points right, "
            "y down and z forward, as in OpenCV)"
        )
    return K


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _read_file(path: Path) -> Camera:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FileNotFoundError(
            f"there is no file of intrinsics {path} ({error.strerror}); intrinsics must be {_FORM}"
        ) from error
    except ValueError as error:
        raise CameraError(f"{path} is not readable as JSON or YAML: {error}") from error
    try:
        content = json.loads(text) if path.suffix.lower() == ".json" else yaml.safe_load(text)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        hint = " (a FileStorage of OpenCV is not read)" if "opencv" in str(error).lower() else ""
        raise CameraError(f"{path} is not readable as JSON or YAML{hint}: {error}") from error
    if not isinstance(content, Mapping):
        raise CameraError(f"{path} must hold a camera, {_FORM}; it holds {type(content).__name__}")
    model = str(content.get("distortion_model") or content.get("cam_model") or "").lower()
    if any(name in model for name in _FISHEYE):
        raise CameraError(f"{path}: fisheye cameras are not supported (the model is {model[:80]!r})")
    size = _size(content)
    for key in ("cam_K", "camera_matrix", "K", "k"):
        if key in content:
            values = content[key]
            K = _matrix(values.get("data") if isinstance(values, Mapping) else values, f"{path}: {key}")
            return Camera(K, _distortion(content, path), size)
    if {"fx", "fy", "cx", "cy"} <= content.keys():
        return Camera(_matrix([content[k] for k in ("fx", "fy", "cx", "cy")], str(path)), [], size)
    if all(isinstance(entry, Mapping) and "cam_K" in entry for entry in content.values()) and content:
        raise CameraError(f"{path} holds the cameras of {len(content)} pictures; give the cam_K of the one")
    raise CameraError(
        f"{path} holds no camera that is known: {_FORM}; its keys are {sorted(map(str, content))[:12]}"
    )


def _size(content: Mapping[str, Any]) -> tuple[int, int] | None:
    for height, width in (("height", "width"), ("image_height", "image_width")):
        if isinstance(content.get(height), int) and isinstance(content.get(width), int):
            return content[height], content[width]
    return None


def _distortion(content: Mapping[str, Any], path: Path) -> list[float]:
    for key in ("distortion_coefficients", "D", "d"):
        values = content.get(key, [])
        values = values.get("data", []) if isinstance(values, Mapping) else values
        if _is_list(values) and all(isinstance(v, int | float) for v in values):
            if any(values):
                return [float(v) for v in values]
        else:
            raise CameraError(f"{path}: {key} must be a list of numbers, got {values!r}")
    return []

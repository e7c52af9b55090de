"""Entries of a scene's JSON files: cameras and annotations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from foundpose.bop.files import BopError

# Published rotations are not exactly orthonormal: LM-O's are scaled by up to 1.005.
ROTATION_TOLERANCE = 0.02


@dataclass(frozen=True)
class Annotation:
    """Ground truth of one object instance.

    Attributes:
        obj_id: the object.
        index: position in the image's list of annotations; names the mask files.
        T_camera_from_model: (4, 4) float64 as published: the rotation's scale may differ from 1 by 2 %.
        visible_fraction: share of the object's silhouette that is visible, or None where it is not annotated.
    """

    obj_id: int
    index: int
    T_camera_from_model: Tensor
    visible_fraction: float | None


def parse_intrinsics(entry: Any, where: str) -> Tensor:
    """Intrinsics (3, 3) float64 of an entry of ``scene_camera.json``, pixels.

    Raises:
        BopError: ``cam_K`` is missing or no matrix of intrinsics, or the camera has another model (fisheye).
    """
    if isinstance(entry, Mapping) and "cam_model" in entry and "cam_K" not in entry:
        model = entry["cam_model"]
        name = model.get("projection_model_type", model) if isinstance(model, Mapping) else model
        raise BopError(
            f"{where}: fisheye cameras are not supported (cam_model in place of cam_K: {name}); undistort the "
            "pictures to a pinhole camera and write its cam_K"
        )
    K = _numbers(entry, "cam_K", 9, where).reshape(3, 3)
    if K[2].tolist() != [0.0, 0.0, 1.0] or K[1, 0] != 0 or not (K[0, 0] > 0 and K[1, 1] > 0):
        raise BopError(
            f"{where}: cam_K must be fx s cx 0 fy cy 0 0 1, row by row, with focal lengths above 0; got "
            f"{K.flatten().tolist()}"
        )
    return K


def parse_depth_scale(entry: Any, where: str) -> float:
    """``depth_scale`` of an entry of ``scene_camera.json``: what makes millimetres of the values of a depth image.

    Raises:
        BopError: it is missing or not positive.
    """
    scale = float(_numbers(entry, "depth_scale", 1, where))
    if not scale > 0:
        raise BopError(f"{where}: depth_scale must be positive, got {scale}")
    return scale


def check_rotation(R: Tensor, name: str) -> None:
    """Raise BopError unless a matrix (3, 3) is a rotation, whose scale may be off by 2 %; say what it is instead."""
    scales = torch.linalg.svdvals(R)
    reflection = bool(torch.linalg.det(R) < 0)
    if bool(((scales - 1).abs() <= ROTATION_TOLERANCE).all()) and not reflection:
        return
    if scales[0] - scales[2] > ROTATION_TOLERANCE * scales[0]:
        fault = f"its axes are not orthogonal (singular values {[round(x, 4) for x in scales.tolist()]})"
    else:
        fault = f"it is {'a reflection' if reflection else 'a rotation'} scaled by {float(scales.mean()):.4g}"
    raise BopError(
        f"{name} must be a rotation, row by row (its scale may be off by {ROTATION_TOLERANCE:.0%}), {fault}; got "
        f"{R.tolist()}"
    )


def parse_annotations(entries: Any, infos: Any, where: str) -> list[Annotation]:
    """Annotations of one image.

    Args:
        entries: of ``scene_gt.json``.
        infos: of ``scene_gt_info.json``, or None where the file is missing.
        where: file and image, for messages.

    Raises:
        BopError: a field is missing, a rotation is none, or the lists differ in length.
    """
    if not isinstance(entries, list):
        raise BopError(f"{where}: must be a list of annotations, got {type(entries).__name__}")
    if infos is None:
        infos = [{}] * len(entries)
    if not isinstance(infos, list) or len(infos) != len(entries):
        got = len(infos) if isinstance(infos, list) else type(infos).__name__
        raise BopError(f"{where}: {len(entries)} annotations, but scene_gt_info.json has {got}")
    if not entries:
        return []
    T = torch.eye(4, dtype=torch.float64).repeat(len(entries), 1, 1)
    for index, entry in enumerate(entries):
        name = f"{where}, annotation {index}"
        T[index, :3, :3] = _numbers(entry, "cam_R_m2c", 9, name).reshape(3, 3)
        T[index, :3, 3] = _numbers(entry, "cam_t_m2c", 3, name)
        check_rotation(T[index, :3, :3], f"{name}: cam_R_m2c")
    return [
        Annotation(
            _object_id(entry, f"{where}, annotation {i}"),
            i,
            T[i],
            _fraction(info, f"{where}, annotation {i}"),
        )
        for i, (entry, info) in enumerate(zip(entries, infos, strict=True))
    ]


def _object_id(entry: Mapping[str, Any], where: str) -> int:
    obj_id = entry.get("obj_id")
    if type(obj_id) is not int:
        raise BopError(f"{where}: obj_id must be a whole number, got {obj_id!r}")
    return obj_id


def _fraction(info: Any, where: str) -> float | None:
    if not isinstance(info, Mapping) or info.get("visib_fract") is None:
        return None
    fraction = float(_numbers(info, "visib_fract", 1, where))
    if not 0 <= fraction <= 1:
        raise BopError(f"{where}: visib_fract must be within 0 and 1, got {fraction}")
    return fraction


def _numbers(entry: Any, name: str, count: int, where: str) -> Tensor:
    """A field of ``count`` finite numbers as (count,) float64."""
    if not isinstance(entry, Mapping) or name not in entry:
        raise BopError(f"{where}: {name} is missing")
    values = entry[name] if isinstance(entry[name], Sequence) else [entry[name]]
    if len(values) != count or not all(type(value) in (int, float) for value in values):
        raise BopError(f"{where}: {name} must be {count} numbers, got {entry[name]!r}")
    numbers = torch.tensor(values, dtype=torch.float64)
    if not bool(torch.isfinite(numbers).all()):
        raise BopError(f"{where}: {name} must be finite, got {entry[name]!r}")
    return numbers

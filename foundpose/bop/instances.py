"""Which regions of which images to estimate: ground-truth masks or detections."""

import heapq
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pycocotools import mask as coco_mask
from torch import Tensor

from foundpose.bop.dataset import BopDataset
from foundpose.bop.files import BopError, iterate_json_list
from foundpose.bop.targets import Target


@dataclass(frozen=True)
class Instance:
    """One region to estimate a pose for.

    Attributes:
        scene_id: the scene.
        im_id: the image.
        obj_id: the object that the region is said to show.
        score: confidence of the detector, 1 for ground truth.
        time: seconds that the detector took for the image, 0 for ground truth.
        segmentation: COCO run-length encoding of the mask, or None for a ground-truth mask.
        annotation_index: which ground-truth mask, or None for a detection.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    time: float
    segmentation: dict[str, Any] | None = None
    annotation_index: int | None = None

    def mask(self, dataset: BopDataset) -> Tensor:
        """The mask (H, W) bool.

        Raises:
            BopError: a mask of another size than its image.
        """
        if self.segmentation is None:
            assert self.annotation_index is not None
            return dataset.visible_mask(self.scene_id, self.im_id, self.annotation_index)
        name = f"a detection of object {self.obj_id} in image {self.im_id} of scene {self.scene_id}"
        try:
            mask = decode_rle(self.segmentation)
        except BopError as error:
            raise BopError(f"{name}: {error}") from error
        size = dataset.image_size(self.scene_id, self.im_id)
        if tuple(mask.shape) != size:
            raise BopError(
                f"{name} has a mask of {mask.shape[1]}x{mask.shape[0]} px, the image has {size[1]}x{size[0]} px"
            )
        return mask


def decode_rle(segmentation: Mapping[str, Any]) -> Tensor:
    """Decode a COCO run-length mask, compressed or not, to (H, W) bool.

    Raises:
        BopError: not a run-length mask.
    """
    packed = compress_rle(segmentation)
    height, width = packed["size"]
    covered = _covered_pixels(packed["counts"])
    # pycocotools would show memory that is not its own.
    if covered != height * width:
        raise BopError(f"run lengths cover {covered} pixels, the size says {height}x{width}")
    return torch.from_numpy(np.ascontiguousarray(coco_mask.decode(packed))).bool()


def compress_rle(segmentation: Mapping[str, Any]) -> dict[str, Any]:
    """A COCO run-length mask with its lengths packed to bytes; what is packed already stays so.

    A list of lengths takes some forty times the memory.

    Raises:
        BopError: not a run-length mask.
    """
    try:
        (height, width), counts = segmentation["size"], segmentation["counts"]
        if not all(type(value) is int and value > 0 for value in (height, width)):
            raise ValueError(f"size must be [height, width], got {segmentation['size']!r}")
        if isinstance(counts, str):
            counts = counts.encode("ascii")
        elif isinstance(counts, list):
            if not all(type(value) is int and value >= 0 for value in counts):
                raise ValueError("counts must be whole numbers of at least 0")
            if sum(counts) != height * width:
                raise BopError(f"run lengths cover {sum(counts)} pixels, the size says {height}x{width}")
            counts = coco_mask.frPyObjects({"size": [height, width], "counts": counts}, height, width)[
                "counts"
            ]
        if not isinstance(counts, bytes):
            raise TypeError(f"counts must be a string or a list, got {type(counts).__name__}")
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, BopError):
            raise
        raise BopError(f"not a COCO run-length mask: {error!r}") from error
    return {"size": [height, width], "counts": counts}


def _covered_pixels(counts: bytes) -> int:
    """Sum of packed run lengths, in COCO's code.

    Each length is written as characters of 5 bits, lowest first, offset by 48, with the 6th bit set where another
    follows; from the fourth on it is the difference to the length two before.

    Raises:
        BopError: not that code.
    """
    digits = np.frombuffer(counts, dtype=np.uint8).astype(np.int64) - 48
    last = (digits & 32) == 0
    if digits.size == 0 or digits.min() < 0 or digits.max() > 63 or not last[-1]:
        raise BopError(
            "not a COCO run-length mask: counts is cut off, or holds characters that do not belong there"
        )
    starts = np.flatnonzero(np.concatenate([[True], last[:-1]]))
    place = np.arange(digits.size) - np.repeat(starts, np.diff([*starts, digits.size]))
    if place.max() > 7:
        raise BopError("not a COCO run-length mask: counts holds a number beyond all images")
    values = np.add.reduceat((digits & 31) << (5 * place), starts)
    # The highest bit of the last character is the sign.
    values -= ((digits[last] >> 4) & 1) << (5 * place[last] + 5)
    lengths = values.copy()
    lengths[1::2] = np.cumsum(values[1::2])
    lengths[2::2] = np.cumsum(values[2::2])
    if lengths.min() < 0:
        raise BopError("not a COCO run-length mask: counts holds a negative length")
    return int(lengths.sum())


def ground_truth_instances(dataset: BopDataset, targets: list[Target] | None = None) -> list[Instance]:
    """Ground-truth masks of the targets: the ``inst_count`` most visible instances of each.

    Of targets that are images (bop24): all instances of which at least a tenth is visible, object by object.
    """
    instances = []
    for target in dataset.localization_targets(targets):
        assert target.obj_id is not None
        found = [a for a in dataset.annotations(target.scene_id, target.im_id) if a.obj_id == target.obj_id]
        found.sort(key=lambda a: -(a.visible_fraction if a.visible_fraction is not None else 1.0))
        instances += [
            Instance(
                target.scene_id, target.im_id, target.obj_id, 1.0, 0.0, annotation_index=annotation.index
            )
            for annotation in found[: target.inst_count]
        ]
    return instances


def detected_instances(
    dataset: BopDataset,
    path: str | Path,
    targets: list[Target] | None = None,
    masks_per_instance: int = 1,
    max_per_image: int | None = 100,
) -> list[Instance]:
    """Detections of the targets, those of highest score; of equal scores, the first in the file.

    Of an object in an image (bop19): ``masks_per_instance * inst_count``. Of an image (bop24): ``max_per_image``.

    Args:
        dataset: the dataset.
        path: detections in the format of the BOP'23 default detections (CNOS): a JSON file, or a folder that
            holds one.
        targets: what to find; all of the dataset's by default.
        masks_per_instance: 1 (the paper's n masks) or more (its 5n); for bop19 targets.
        max_per_image: for bop24 targets; 100 is the benchmark's limit, None is none.

    Returns:
        Target by target, best score first. Masks stay run lengths until they are asked for.

    Raises:
        FileNotFoundError: no such file.
        BopError: an entry lacks a field, has one that cannot be right, or is of an object that the dataset has not.
    """
    if masks_per_instance < 1:
        raise ValueError(f"masks_per_instance must be at least 1, got {masks_per_instance}")
    if max_per_image is not None and max_per_image < 1:
        raise ValueError(f"max_per_image must be at least 1 or null, got {max_per_image}")
    path = _single_json(Path(path))
    targets = dataset.targets() if targets is None else targets
    limits: dict[tuple[int, int, int | None], float] = {}
    for target in targets:
        if target.inst_count is not None:
            limits[target[:3]] = masks_per_instance * target.inst_count
        else:
            limits[target[:3]] = math.inf if max_per_image is None else max_per_image
    objects = set(dataset.models_info)
    # For each target the best so far, worst of them first: (score, minus position in the file, instance).
    best: dict[tuple[int, int, int | None], list[tuple[float, int, Instance]]] = defaultdict(list)
    for position, entry in enumerate(iterate_json_list(path)):
        where = f"{path}: entry {position}"
        scene_id, im_id, obj_id, score, time = _fields(entry, where)
        if obj_id not in objects:
            raise BopError(f"{where} is of object {obj_id}; the dataset has {sorted(objects)}")
        key: tuple[int, int, int | None] = (scene_id, im_id, obj_id)
        if key not in limits:
            key = (scene_id, im_id, None)
        limit = limits.get(key, 0)
        if limit == 0 or (len(best[key]) == limit and best[key][0][0] >= score):
            continue
        try:
            segmentation = compress_rle(entry["segmentation"])
        except BopError as error:
            raise BopError(f"{where}: {error}") from error
        item = (score, -position, Instance(scene_id, im_id, obj_id, score, time, segmentation))
        if len(best[key]) == limit:
            heapq.heapreplace(best[key], item)
        else:
            heapq.heappush(best[key], item)
    return [
        instance
        for target in targets
        for _, _, instance in sorted(best[target[:3]], key=lambda i: i[:2])[::-1]
    ]


def _fields(entry: Any, where: str) -> tuple[int, int, int, float, float]:
    """Scene, image, object, score and time of a detection."""
    try:
        ids = [entry[name] for name in ("scene_id", "image_id", "category_id")]
        score, time = float(entry["score"]), float(entry.get("time", 0.0))
        entry["segmentation"]
        if not all(type(value) is int for value in ids):
            raise TypeError(f"scene_id, image_id and category_id must be whole numbers, got {ids}")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BopError(f"{where} lacks or misspells a field: {error!r}") from error
    if not math.isfinite(score):
        raise BopError(f"{where}: score must be finite, got {score}")
    if not 0 <= time < math.inf:
        raise BopError(f"{where}: time must be seconds, at least 0, got {time}")
    return ids[0], ids[1], ids[2], score, time


def _single_json(path: Path) -> Path:
    """The file itself, or the only JSON file of a folder."""
    if not path.is_dir():
        return path
    files = sorted(path.glob("*.json"))
    if len(files) != 1:
        raise FileNotFoundError(
            f"expected one JSON file of detections in {path}, found {[f.name for f in files]}; name the file"
        )
    return files[0]

"""Which regions of which images to estimate: ground-truth masks or detections."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pycocotools import mask as coco_mask
from torch import Tensor

from foundpose.bop.dataset import BopDataset, Target
from foundpose.bop.files import BopError, read_json


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
        if self.segmentation is not None:
            mask = decode_rle(self.segmentation)
            size = dataset.image_size(self.scene_id, self.im_id)
            if tuple(mask.shape) != size:
                raise BopError(
                    f"a detection of object {self.obj_id} in image {self.im_id} of scene {self.scene_id} has "
                    f"a mask of {mask.shape[1]}x{mask.shape[0]} px, the image has {size[1]}x{size[0]} px"
                )
            return mask
        assert self.annotation_index is not None
        return dataset.visible_mask(self.scene_id, self.im_id, self.annotation_index)


def decode_rle(segmentation: dict[str, Any]) -> Tensor:
    """Decode a COCO run-length mask, compressed or not, to (H, W) bool.

    Raises:
        BopError: not a run-length mask.
    """
    try:
        height, width = segmentation["size"]
        counts = segmentation["counts"]
        if isinstance(counts, list):
            if sum(counts) != height * width:
                raise BopError(f"run lengths cover {sum(counts)} pixels, the size says {height}x{width}")
            encoded = coco_mask.frPyObjects(segmentation, height, width)
        else:
            encoded = segmentation
        return torch.from_numpy(np.ascontiguousarray(coco_mask.decode(encoded))).bool()
    except (KeyError, TypeError, ValueError) as error:
        raise BopError(f"not a COCO run-length mask: {error}") from error


def ground_truth_instances(dataset: BopDataset, targets: list[Target] | None = None) -> list[Instance]:
    """Ground-truth masks of the targets: the ``inst_count`` most visible instances of each."""
    instances = []
    for target in dataset.targets() if targets is None else targets:
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
    dataset: BopDataset, path: str | Path, targets: list[Target] | None = None, masks_per_instance: int = 1
) -> list[Instance]:
    """Detections of the targets: the ``masks_per_instance * inst_count`` of highest score of each.

    Args:
        dataset: the dataset.
        path: detections in the format of the BOP'23 default detections (CNOS): a JSON file, or a folder that
            holds one.
        targets: what to localise; all of the dataset's by default.
        masks_per_instance: 1 (the paper's n masks) or more (its 5n).

    Raises:
        FileNotFoundError: no such file.
        BopError: an entry lacks a field.
    """
    if masks_per_instance < 1:
        raise ValueError(f"masks_per_instance must be at least 1, got {masks_per_instance}")
    path = _single_json(Path(path))
    by_target: dict[tuple[int, int, int], list[Instance]] = defaultdict(list)
    for position, entry in enumerate(read_json(path)):
        try:
            instance = Instance(
                scene_id=int(entry["scene_id"]),
                im_id=int(entry["image_id"]),
                obj_id=int(entry["category_id"]),
                score=float(entry["score"]),
                time=float(entry.get("time", 0.0)),
                segmentation=entry["segmentation"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise BopError(f"{path}: entry {position} lacks or misspells a field: {error!r}") from error
        by_target[instance.scene_id, instance.im_id, instance.obj_id].append(instance)
    instances = []
    for target in dataset.targets() if targets is None else targets:
        found = by_target.get((target.scene_id, target.im_id, target.obj_id), [])
        # A stable sort: equal scores keep the order of the file.
        instances += sorted(found, key=lambda i: -i.score)[: masks_per_instance * target.inst_count]
    return instances


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

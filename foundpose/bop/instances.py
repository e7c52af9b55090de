"""Which regions of which images to estimate: ground-truth masks or detections."""

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from foundpose.bop.dataset import BopDataset
from foundpose.bop.files import BopError, read_json
from foundpose.bop.masks import plausible_mask
from foundpose.bop.matching import best
from foundpose.bop.segmentation import decode_segmentation, pack_segmentation
from foundpose.bop.targets import Target, describe_target


@dataclass(frozen=True)
class Instance:
    """One region to estimate a pose for.

    Attributes:
        scene_id: the scene.
        im_id: the image.
        obj_id: the object that the region is said to show.
        score: confidence of the detector, 1 for ground truth.
        time: seconds that the detector took for the image, 0 for ground truth.
        segmentation: packed run lengths or polygons of the mask, or None for a ground-truth mask.
        annotation_index: which ground-truth mask, or None for a detection.
        largest_component: of a detection whose pieces lie far apart, see :func:`foundpose.bop.plausible_mask`, take
            the largest alone.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    time: float
    segmentation: dict[str, Any] | list[list[float]] | None = None
    annotation_index: int | None = None
    largest_component: bool = True

    def mask(self, dataset: BopDataset) -> Tensor:
        """The mask (H, W) bool.

        Raises:
            BopError: not a mask, or one of another size than its image.
        """
        if self.segmentation is None:
            assert self.annotation_index is not None
            return dataset.visible_mask(self.scene_id, self.im_id, self.annotation_index)
        name = f"a detection of {describe_target(self.scene_id, self.im_id, self.obj_id)}"
        try:
            mask = decode_segmentation(self.segmentation, dataset.image_size(self.scene_id, self.im_id))
        except BopError as error:
            raise BopError(f"{name}: {error}") from error
        return plausible_mask(mask, name, self.largest_component)


def ground_truth_instances(dataset: BopDataset, targets: list[Target] | None = None) -> list[Instance]:
    """Ground-truth masks of the targets: the ``inst_count`` most visible instances of each.

    Of targets that are images (bop24): all instances of which at least a tenth is visible, object by object.
    """
    instances = []
    for target in dataset.localization_targets(targets):
        assert target.obj_id is not None
        found = [a for a in dataset.annotations(target.scene_id, target.im_id) if a.obj_id == target.obj_id]
        visible = [1.0 if a.visible_fraction is None else a.visible_fraction for a in found]
        instances += [
            Instance(target.scene_id, target.im_id, target.obj_id, 1.0, 0.0, annotation_index=found[i].index)
            for i in best(visible, target.inst_count)
        ]
    return instances


def detected_instances(
    dataset: BopDataset,
    path: str | Path,
    targets: list[Target] | None = None,
    masks_per_instance: int = 1,
    max_per_image: int | None = 100,
    largest_component: bool = True,
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
        largest_component: of masks whose pieces lie far apart take the largest alone.

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
    targets = dataset.targets() if targets is None else targets
    entries, path = read_detection_file(path)
    wanted = {target[:3] for target in targets}
    found: dict[tuple[int, int, int | None], list[Instance]] = {key: [] for key in wanted}
    for position, entry in enumerate(entries):
        instance = _instance(entry, dataset, f"{path}: entry {position}", largest_component)
        image = (instance.scene_id, instance.im_id)
        for key in ((*image, instance.obj_id), (*image, None)):
            if key in wanted:
                found[key].append(instance)
    chosen: list[Instance] = []
    for target in targets:
        limit = max_per_image if target.inst_count is None else masks_per_instance * target.inst_count
        mine = found[target[:3]]
        chosen += [mine[i] for i in best([instance.score for instance in mine], limit)]
    return chosen


def _packed(entry: dict[str, Any]) -> dict[str, Any]:
    """An object of a file of detections, with its segmentation packed; one that is wrong stays as it is."""
    if "segmentation" in entry:
        with contextlib.suppress(BopError):
            entry["segmentation"] = pack_segmentation(entry["segmentation"])
    return entry


def read_detection_file(path: str | Path) -> tuple[list[Any], Path]:
    """Entries of a file of detections, or of the only one of a folder, and the file.

    Raises:
        FileNotFoundError: no such file.
        BopError: not a list.
    """
    path = _single_json(Path(path))
    # Packed while they are read: as Python objects, a file's run lengths take many times its size.
    entries = read_json(path, _packed)
    if not isinstance(entries, list):
        raise BopError(f"{path} must hold a JSON list of detections, it holds {type(entries).__name__}")
    return entries, path


def check_detection(entry: Any, dataset: BopDataset, where: str) -> tuple[list[int], float, float]:
    """Scene, image and object, score, and time of an entry of a file of detections.

    Raises:
        BopError: a field is missing or cannot be right, or the dataset has no such object.
    """
    try:
        ids = [entry[name] for name in ("scene_id", "image_id", "category_id")]
        score, time = float(entry["score"]), float(entry.get("time", 0.0))
        if not all(type(value) is int for value in ids):
            raise TypeError(f"scene_id, image_id and category_id must be whole numbers, got {ids}")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BopError(f"{where} lacks or misspells a field: {error!r}") from error
    if not math.isfinite(score):
        raise BopError(f"{where}: score must be finite, got {score}")
    if not 0 <= time < math.inf:
        raise BopError(f"{where}: time must be seconds, at least 0, got {time}")
    if ids[2] not in dataset.models_info:
        raise BopError(f"{where} is of object {ids[2]}; the dataset has {dataset.object_ids}")
    return ids, score, time


def _instance(entry: Any, dataset: BopDataset, where: str, largest_component: bool) -> Instance:
    """A detection of an entry of a file.

    Raises:
        BopError: a field is missing or cannot be right.
    """
    ids, score, time = check_detection(entry, dataset, where)
    if "segmentation" not in entry:
        raise BopError(f"{where} lacks or misspells a field: {KeyError('segmentation')!r}")
    try:
        packed = pack_segmentation(entry["segmentation"])
    except BopError as error:
        raise BopError(f"{where}: {error}") from error
    return Instance(ids[0], ids[1], ids[2], score, time, packed, largest_component=largest_component)


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

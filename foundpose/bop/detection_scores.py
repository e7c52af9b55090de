"""Average precision of 2D detections by COCO's rules, as the BOP challenge uses them."""

import contextlib
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torch import Tensor

from foundpose.bop.dataset import BopDataset
from foundpose.bop.files import BopError
from foundpose.bop.instances import check_detection, read_detection_file
from foundpose.bop.localization import check_ground_truth
from foundpose.bop.scores import percent, text_table
from foundpose.bop.segmentation import decode_segmentation
from foundpose.bop.targets import MIN_VISIBLE_FRACTION, describe_target

KINDS = ("segm", "bbox", "bbox_modal")
"""Masks of the visible part; boxes of the whole silhouette, as the benchmark compares; boxes of the visible part."""


class _Entry(NamedTuple):
    """A detection of a file."""

    image: tuple[int, int]
    obj_id: int
    score: float
    time: float
    box: list[float]
    segmentation: Any
    where: str


@dataclass(frozen=True)
class KindPrecision:
    """Average precision of one kind of detection; None where there is nothing to find.

    Attributes:
        AP: mean over the IoU thresholds 0.5, 0.55, …, 0.95, and over the objects that there are to find.
        AP50: at 0.5.
        AP75: at 0.75.
        AR: best recall with 100 detections per image and object, averaged alike.
        objects: AP by object id.
    """

    AP: float | None
    AP50: float | None
    AP75: float | None
    AR: float | None
    objects: dict[int, float | None]


@dataclass(frozen=True)
class DetectionScores:
    """Average precision of a set of 2D detections on a dataset.

    Attributes:
        kinds: by name, see :data:`KINDS`.
        targets: instances to be found, by object id.
        facts: what was counted, by name.
    """

    kinds: dict[str, KindPrecision]
    targets: dict[int, int]
    facts: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Plain numbers."""
        kinds: dict[str, Any] = {
            name: vars(kind) | {"objects": {str(k): v for k, v in kind.objects.items()}}
            for name, kind in self.kinds.items()
        }
        return self.facts | kinds | {"objects": {str(k): {"targets": n} for k, n in self.targets.items()}}

    def table(self) -> str:
        """A short table: AP by object and kind, and of all together."""
        rows = [
            {"object": str(obj_id), "targets": str(count)}
            | {f"AP_{name}": percent(kind.objects[obj_id]) for name, kind in self.kinds.items()}
            for obj_id, count in self.targets.items()
        ]
        total = {"object": "all", "targets": str(sum(self.targets.values()))}
        return text_table(
            [*rows, total | {f"AP_{name}": percent(kind.AP) for name, kind in self.kinds.items()}]
        )


def detection_scores(
    dataset: BopDataset,
    detections: str | Path | Sequence[Mapping[str, Any]],
    kinds: Sequence[str] = KINDS,
    images: Sequence[tuple[int, int]] | None = None,
    object_ids: Sequence[int] | None = None,
) -> DetectionScores:
    """Average precision of detections and segmentations: the numbers that BOP's toolkit gives.

    COCO's evaluation (pycocotools) on the images of the targets. To be found is every annotated instance of which at
    least a tenth is visible; a detection matched to another one is neither right nor wrong, and instances without a
    visible pixel do not exist. Up to 100 detections per image and object count. Boxes are those of the pixels of
    ``mask/`` (silhouettes cut at the border of the image) or ``mask_visib/``.

    Args:
        dataset: the dataset, with ground truth, visible fractions and masks.
        detections: a file of the format of the BOP'23 default detections or a folder that holds one, or its entries:
            ``scene_id``, ``image_id``, ``category_id``, ``score``, ``bbox`` [x, y, width, height], ``segmentation``
            (COCO), ``time``. An entry without box or segmentation (or with an empty one) is left out where it is
            needed.
        kinds: what to compare, some of :data:`KINDS`.
        images: (scene, image) to look at; those of all targets by default.
        object_ids: objects to look at; all by default.

    Raises:
        ValueError: an unknown kind.
        BopError: no ground truth, one that does not say what is visible, or an entry that cannot be right.
        FileNotFoundError: a file is missing.

    Differentiable w.r.t. nothing.
    Source: Hodaň et al., "BOP Challenge 2023", section 2.2; Lin et al., "Microsoft COCO".
    """
    if not kinds or not set(kinds) <= set(KINDS):
        raise ValueError(f"kinds must be some of {', '.join(KINDS)}, got {list(kinds)}")
    images = sorted(set(dataset.images() if images is None else images))
    check_ground_truth(dataset, {scene_id for scene_id, _ in images})
    number = {image: i for i, image in enumerate(images, start=1)}
    ids = dataset.object_ids if object_ids is None else sorted(object_ids)
    found = _entries(dataset, detections)
    mine = [entry for entry in found if entry.image in number and entry.obj_id in ids]
    truths = _truths(dataset, images, ids, amodal="bbox" in kinds)
    targets = Counter(truth["category_id"] for truth in truths if not truth["hidden"])
    shapes = [
        dict(zip(("id", "height", "width"), (number[image], *dataset.image_size(*image)), strict=True))
        for image in images
    ]
    own = [_detection(entry, number[entry.image], dataset, segm="segm" in kinds) for entry in mine]
    scores = {kind: _evaluate(kind, shapes, ids, truths, own) for kind in kinds}
    times = {entry.image: entry.time for entry in mine}
    facts = {
        "dataset": dataset.name,
        "split": dataset.split.name,
        "images": len(images),
        "targets": sum(targets.values()),
        "annotations_not_counted": sum(truth["hidden"] for truth in truths),
        "detections_in_file": len(found),
        "detections_of_targets": len(mine),
        "average_time_per_image": sum(times.values()) / len(times) if times else None,
    }
    return DetectionScores(scores, dict(sorted(targets.items())), facts)


def _truths(
    dataset: BopDataset, images: Sequence[tuple[int, int]], ids: Sequence[int], amodal: bool
) -> list[dict[str, Any]]:
    """Annotated instances with a visible pixel, as COCO's annotations."""
    truths: list[dict[str, Any]] = []
    for number, image in enumerate(images, start=1):
        for annotation in dataset.annotations(*image):
            if annotation.obj_id not in ids:
                continue
            if annotation.visible_fraction is None:
                raise BopError(
                    f"the visible fraction of {describe_target(*image, annotation.obj_id)} is not known: "
                    "scene_gt_info.json with visib_fract is needed to tell which instances count"
                )
            visible = _packed(dataset.visible_mask(*image, annotation.index))
            if not coco_mask.area(visible):
                continue
            whole = _packed(dataset.mask(*image, annotation.index)) if amodal else visible
            truths.append(
                {
                    "image_id": number,
                    "category_id": annotation.obj_id,
                    "iscrowd": 0,
                    "area": 1,  # no matter: sizes are not told apart
                    "segmentation": visible,
                    "bbox": coco_mask.toBbox(whole).tolist(),
                    "bbox_modal": coco_mask.toBbox(visible).tolist(),
                    "hidden": annotation.visible_fraction < MIN_VISIBLE_FRACTION,
                }
            )
    return truths


def _entries(dataset: BopDataset, detections: str | Path | Sequence[Mapping[str, Any]]) -> list[_Entry]:
    name = "detections"
    if isinstance(detections, str | Path):
        detections, path = read_detection_file(detections)
        name = str(path)
    entries = []
    for position, entry in enumerate(detections):
        where = f"{name}: entry {position}"
        ids, score, time = check_detection(entry, dataset, where)
        box = entry.get("bbox") or []
        if len(box) not in (0, 4) or not all(type(v) in (int, float) and math.isfinite(v) for v in box):
            raise BopError(f"{where}: bbox must be [x, y, width, height], got {box}")
        entries.append(_Entry((ids[0], ids[1]), ids[2], score, time, box, entry.get("segmentation"), where))
    return entries


def _detection(entry: _Entry, number: int, dataset: BopDataset, segm: bool) -> dict[str, Any]:
    """An entry as COCO's annotation."""
    coco: dict[str, Any] = {
        "image_id": number,
        "category_id": entry.obj_id,
        "score": entry.score,
        "iscrowd": 0,
        "area": 1,
    }
    if entry.box:
        coco |= {"bbox": entry.box, "bbox_modal": entry.box}
    if segm and entry.segmentation:
        try:
            mask = decode_segmentation(entry.segmentation, dataset.image_size(*entry.image))
        except BopError as error:
            raise BopError(f"{entry.where}: {error}") from error
        coco["segmentation"] = _packed(mask)
    return coco


def _packed(mask: Tensor) -> dict[str, Any]:
    packed: dict[str, Any] = coco_mask.encode(np.asfortranarray(mask.numpy().astype(np.uint8)))
    return packed


class _Evaluation(COCOeval):
    """COCO's evaluation that heeds which annotations to ignore: pycocotools' own takes ``iscrowd`` for it."""

    def _prepare(self) -> None:
        super()._prepare()
        for truths in self._gts.values():
            for truth in truths:
                truth["ignore"] = truth["hidden"]


def _evaluate(
    kind: str,
    images: Sequence[Mapping[str, int]],
    ids: Sequence[int],
    truths: Sequence[Mapping[str, Any]],
    detections: Sequence[Mapping[str, Any]],
) -> KindPrecision:
    field = "segmentation" if kind == "segm" else kind
    name = "segmentation" if kind == "segm" else "bbox"
    sides = []
    with contextlib.redirect_stdout(io.StringIO()):
        for annotations in (truths, detections):
            # Ids from 1, since 0 means no match; copies, since pycocotools writes into them.
            chosen = [a for a in annotations if field in a]
            own = [dict(a) | {name: a[field], "id": i} for i, a in enumerate(chosen, start=1)]
            categories = [{"id": obj_id, "name": str(obj_id)} for obj_id in ids]
            side = COCO()
            side.dataset = {"images": list(images), "categories": categories, "annotations": own}
            side.createIndex()
            sides.append(side)
        evaluation = _Evaluation(*sides, "segm" if kind == "segm" else "bbox")
        evaluation.params.areaRng, evaluation.params.maxDets = evaluation.params.areaRng[:1], [100]
        evaluation.evaluate()
        evaluation.accumulate()
    # (IoU, recalls, objects, sizes, detections per image); −1 where there is nothing to find.
    precision, recall = (evaluation.eval[name][..., 0, 0] for name in ("precision", "recall"))
    objects = {obj_id: _mean(precision[..., k]) for k, obj_id in enumerate(ids)}
    return KindPrecision(_mean(precision), _mean(precision[0]), _mean(precision[5]), _mean(recall), objects)


def _mean(values: np.ndarray) -> float | None:
    values = values[values > -1]
    return float(values.mean()) if values.size else None

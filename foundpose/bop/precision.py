"""Average precision of 6D detection by the rules of BOP'24."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from foundpose.bop.dataset import BopDataset
from foundpose.bop.localization import Localization, check_ground_truth, tabulate
from foundpose.bop.matching import best, greedy_matches
from foundpose.bop.results import PoseResult
from foundpose.bop.scores import percent, text_table
from foundpose.bop.scoring import THRESHOLDS, Progress, model_errors
from foundpose.bop.targets import MIN_VISIBLE_FRACTION, count_visible

ERRORS = ("mssd", "mspd")
"""Errors whose average precisions make up the benchmark's AP."""

MAX_PER_IMAGE = 100
"""So many of an image's estimates count, those of highest score."""


def average_precision(correct: Tensor, counted: Tensor, targets: int) -> Tensor:
    """Mean of the interpolated precision at the recalls 0, 0.01, …, 1, as COCO has it.

    The interpolated precision at a recall is the best precision at that recall or a higher one, and 0 at recalls that
    are not reached.

    Args:
        correct: (..., R) bool, detections by falling score.
        counted: (..., R) bool; what is not counted is neither right nor wrong.
        targets: how many there are to be found, at least 1.

    Returns:
        (...) float64 in [0, 1].

    Differentiable w.r.t. nothing.
    """
    right = (correct & counted).cumsum(-1).double()
    recall = right / targets
    precision = right / counted.cumsum(-1).clamp(min=1)
    envelope = precision.flip(-1).cummax(-1).values.flip(-1) if precision.shape[-1] else precision
    # NumPy's steps, which are COCO's to the last bit.
    wanted = torch.from_numpy(np.linspace(0.0, 1.0, 101)).expand(*recall.shape[:-1], -1).contiguous()
    place = torch.searchsorted(recall.contiguous(), wanted)
    reached = torch.cat([envelope, torch.zeros_like(envelope[..., :1].sum(-1, keepdim=True))], dim=-1)
    return reached.gather(-1, place).mean(-1)


@dataclass(frozen=True)
class PosePrecision:
    """Average precision of 6D detection.

    Attributes:
        precisions: by error function and object id: (T,) float64, the AP at each of the error's thresholds.
        targets: by object id, instances to be found; objects without any have no AP.
        facts: what was counted, by name.
    """

    precisions: dict[str, dict[int, Tensor]]
    targets: dict[int, int]
    facts: dict[str, int]

    def average(self, function: str, obj_id: int | None = None) -> float | None:
        """Mean AP over the thresholds, and over all objects unless it is for one; None without targets."""
        objects = self.precisions[function]
        chosen = list(objects.values()) if obj_id is None else [objects[obj_id]]
        return float(torch.stack(chosen).mean()) if chosen else None

    def overall(self, obj_id: int | None = None) -> float | None:
        """The benchmark's AP: the mean of AP_MSSD and AP_MSPD; None without targets."""
        averages = [self.average(function, obj_id) for function in ERRORS]
        present = [average for average in averages if average is not None]
        return sum(present) / len(ERRORS) if present else None

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, for ``scores.json``."""

        def averages(obj_id: int | None) -> dict[str, float | None]:
            each = {f"AP_{name.upper()}": self.average(name, obj_id) for name in ERRORS}
            return {"AP": self.overall(obj_id)} | each

        objects = {
            str(obj_id): {"targets": count}
            | averages(obj_id)
            | {name: self.precisions[name][obj_id].tolist() for name in ERRORS}
            for obj_id, count in self.targets.items()
        }
        thresholds = {f"{name}_thresholds": list(THRESHOLDS[name]) for name in ERRORS}
        return averages(None) | self.facts | thresholds | {"objects": objects}

    def table(self) -> str:
        """A short table: a row for each object and one for all together."""
        total = sum(self.targets.values())
        return text_table(
            [
                {"object": "all" if obj_id is None else str(obj_id), "targets": str(count)}
                | {f"AP_{name.upper()}": percent(self.average(name, obj_id)) for name in ERRORS}
                | {"AP": percent(self.overall(obj_id))}
                for obj_id, count in [*self.targets.items(), (None, total)]
            ]
        )


def score_pose_detections(
    dataset: BopDataset,
    results: Sequence[PoseResult],
    images: Sequence[tuple[int, int]] | None = None,
    object_ids: Sequence[int] | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> PosePrecision:
    """Average precision of estimates as 6D detections: the numbers that BOP's toolkit gives for BOP'24.

    Of an image the 100 estimates of highest score count. In each image, those of an object are matched greedily, by
    falling score, to the annotations of it with the smallest error below the threshold. To be found is every instance
    of which at least a tenth is visible; an estimate matched to another one is neither right nor wrong. As in the
    toolkit, estimates of an object that the image has no annotation of are not counted at all, not even as wrong
    (``estimates_not_counted``). AP is taken at each threshold and object, over all images together, see
    :func:`average_precision`; then averaged over thresholds, objects and the two errors.

    Args:
        dataset: the dataset, with ground truth, visible fractions and the models for evaluation.
        results: the estimates, in the order in which equal scores of an image are taken.
        images: (scene, image) to look at; those of all targets by default.
        object_ids: objects to look at; all by default.
        device: where errors are computed, in float64.
        progress: called with a stage, what is done of it, and its total.

    Raises:
        BopError: no ground truth, or one that does not say what is visible.
        FileNotFoundError: a file of the dataset is missing.

    Differentiable w.r.t. nothing.
    Source: Nguyen et al., "BOP Challenge 2024", section 2; the toolkit where that is silent.
    """
    images = sorted(set(dataset.images() if images is None else images))
    check_ground_truth(dataset, {scene_id for scene_id, _ in images})
    ids = dataset.object_ids if object_ids is None else sorted(object_ids)
    targets = [
        target
        for image in images
        for target in count_visible(
            *image, [(a.obj_id, a.visible_fraction) for a in dataset.annotations(*image)], at_least=0.0
        )
        if target.obj_id in ids
    ]
    kept = _best_of_images(results, set(images))
    tables = tabulate(dataset, kept, targets, all_estimates=True)
    errors = model_errors(dataset, tables, ERRORS, device, progress)
    score = torch.tensor([result.score for result in kept], dtype=torch.float64)
    hidden = tables.visibility < MIN_VISIBLE_FRACTION
    wanted = _per_object(((tables.annotations >= 0) & ~_at(hidden, tables.annotations)).sum(1), tables)
    return PosePrecision(
        {name: _precisions(name, errors[name], tables, score, hidden, wanted) for name in ERRORS},
        {obj_id: count for obj_id, count in wanted.items() if count},
        {
            "images": len(images),
            "targets": sum(wanted.values()),
            "annotations_not_counted": int(hidden.sum()),
            "estimates_counted": len(kept) - tables.outside,
            "estimates_not_counted": len(results) - len(kept) + tables.outside,
        },
    )


def _best_of_images(results: Sequence[PoseResult], images: set[tuple[int, int]]) -> list[PoseResult]:
    by_image: dict[tuple[int, int], list[PoseResult]] = defaultdict(list)
    for result in results:
        if (result.scene_id, result.im_id) in images:
            by_image[result.scene_id, result.im_id].append(result)
    return [
        members[i]
        for members in by_image.values()
        for i in best([result.score for result in members], MAX_PER_IMAGE)
    ]


def _at(values: Tensor, index: Tensor) -> Tensor:
    """``values[index]`` of bools, False at padding (−1)."""
    return torch.cat([values, values.new_zeros(1)])[index]


def _per_object(counts: Tensor, tables: Localization) -> dict[int, int]:
    sums = counts.new_zeros(len(tables.object_ids)).index_add(0, tables.object, counts)
    return dict(zip(tables.object_ids, sums.tolist(), strict=True))


def _precisions(
    name: str, errors: Tensor, tables: Localization, score: Tensor, hidden: Tensor, wanted: dict[int, int]
) -> dict[int, Tensor]:
    """AP (T,) of the objects that there are to find, from errors (N, n, g)."""
    thresholds = torch.tensor(THRESHOLDS[name], dtype=torch.float64)
    place = greedy_matches(errors, thresholds)  # (N, T, g)
    n = errors.shape[1]
    matched = torch.zeros(*place.shape[:2], n + 1, dtype=torch.int64)
    # 1: to an instance that counts; 2: to one that does not.
    value = (1 + _at(hidden, tables.annotations).long())[:, None].expand_as(place)
    matched.scatter_(-1, torch.where(place < 0, n, place), value)
    precisions = {}
    for index, obj_id in enumerate(tables.object_ids):
        if not wanted[obj_id]:
            continue
        mine = tables.object == index
        used = tables.estimates[mine] >= 0
        order = score[tables.estimates[mine][used]].argsort(descending=True, stable=True)
        state = matched[mine][..., :n].transpose(1, 2)[used][order].T
        precisions[obj_id] = average_precision(state == 1, state != 2, wanted[obj_id])
    return precisions

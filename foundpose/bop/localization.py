"""Targets, annotations and estimates of an evaluation as padded tables."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from foundpose.bop.dataset import BopDataset
from foundpose.bop.files import BopError
from foundpose.bop.matching import best
from foundpose.bop.results import PoseResult
from foundpose.bop.targets import Target


@dataclass(frozen=True)
class Localization:
    """N targets with the estimates that count and the annotations to be found, in the order that matching wants.

    Attributes:
        images: I pairs (scene, image), ascending.
        image: (N,) index into ``images``.
        object_ids: O ids, ascending.
        object: (N,) index into ``object_ids``.
        inst_count: (N,) instances that each target asks for.
        estimates: (N, n) index into ``T_est``, best first; −1 is padding.
        annotations: (N, g) index into ``T_true``; −1 is padding.
        T_est: (R, 4, 4) float64, poses of all results.
        T_true: (A, 4, 4) float64, true poses.
        visibility: (A,) float64, visible share of each annotated instance; 1 where it is not known.
        outside: number of results that belong to no target.
    """

    images: list[tuple[int, int]]
    image: Tensor
    object_ids: list[int]
    object: Tensor
    inst_count: Tensor
    estimates: Tensor
    annotations: Tensor
    T_est: Tensor
    T_true: Tensor
    visibility: Tensor
    outside: int

    def pairs(self) -> Tensor:
        """(P, 3) target, place of the estimate, place of the annotation: all errors that are needed."""
        return ((self.estimates >= 0)[:, :, None] & (self.annotations >= 0)[:, None]).nonzero()


def localization(
    dataset: BopDataset, results: Sequence[PoseResult], targets: Sequence[Target] | None = None
) -> Localization:
    """Sort estimates and ground truth by target, by the rules of BOP'19; all targets of the dataset by default.

    Counted are, for each target, the ``inst_count`` estimates of highest score; to be found are the ``inst_count``
    most visible annotations (one of unknown visibility counts as fully visible). Of equal ones the first in the order
    given come first.

    Raises:
        BopError: the split has no ground truth, or no targets.
    """
    asked = dataset.targets() if targets is None else list(targets)
    check_ground_truth(dataset, {target.scene_id for target in asked})
    targets = dataset.localization_targets(asked)
    if not targets:
        raise BopError(
            f"there is nothing to localise: no targets (those of the dataset: {dataset.targets_path})"
        )
    return tabulate(dataset, results, targets)


def check_ground_truth(dataset: BopDataset, scenes: Iterable[int]) -> None:
    """Raise BopError unless scenes have annotations."""
    for scene_id in sorted(set(scenes)):
        if not dataset.has_ground_truth(scene_id):
            raise BopError(
                f"scene {scene_id} of {dataset.split} has no ground truth (scene_gt.json), so scores cannot be "
                "computed here; results on a test set without it are scored on the benchmark's site"
            )


def tabulate(
    dataset: BopDataset, results: Sequence[PoseResult], targets: Sequence[Target], all_estimates: bool = False
) -> Localization:
    """Sort estimates and ground truth by target; all of a target's estimates, or so many as it has instances."""
    keys = [(t.scene_id, t.im_id, t.obj_id) for t in targets]
    number = {key: n for n, key in enumerate(keys)}
    images = sorted({key[:2] for key in keys})
    image_number = {image: i for i, image in enumerate(images)}
    object_ids = sorted({obj_id for *_, obj_id in keys if obj_id is not None})
    estimates: list[list[int]] = [[] for _ in targets]
    outside = 0
    for index, result in enumerate(results):
        n = number.get((result.scene_id, result.im_id, result.obj_id))
        if n is None:
            outside += 1
        else:
            estimates[n].append(index)
    annotations: list[list[int]] = [[] for _ in targets]
    poses: list[Tensor] = []
    visibility: list[float] = []
    for scene_id, im_id in images:
        for annotation in dataset.annotations(scene_id, im_id):
            n = number.get((scene_id, im_id, annotation.obj_id))
            if n is not None:
                annotations[n].append(len(poses))
                poses.append(annotation.T_camera_from_model)
                visible = annotation.visible_fraction
                visibility.append(1.0 if visible is None else visible)
    for n, target in enumerate(targets):
        count = target.inst_count
        kept = best([results[r].score for r in estimates[n]], None if all_estimates else count)
        estimates[n] = [estimates[n][i] for i in kept]
        # In the order given, which decides between equal errors.
        annotations[n] = [
            annotations[n][i] for i in sorted(best([visibility[a] for a in annotations[n]], count))
        ]
    return Localization(
        images=images,
        image=torch.tensor([image_number[key[:2]] for key in keys]),
        object_ids=object_ids,
        object=torch.tensor([object_ids.index(obj_id) for *_, obj_id in keys if obj_id is not None]),
        inst_count=torch.tensor([t.inst_count for t in targets]),
        estimates=_padded(estimates),
        annotations=_padded(annotations),
        T_est=_stacked([result.T_camera_from_model for result in results]),
        T_true=_stacked(poses),
        visibility=torch.tensor(visibility, dtype=torch.float64),
        outside=outside,
    )


def _padded(lists: list[list[int]]) -> Tensor:
    rows = [torch.tensor(row, dtype=torch.int64) for row in lists]
    return pad_sequence(rows, batch_first=True, padding_value=-1)


def _stacked(poses: list[Tensor]) -> Tensor:
    return torch.stack(poses).to(torch.float64) if poses else torch.zeros(0, 4, 4, dtype=torch.float64)

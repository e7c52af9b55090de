"""Average recall of pose estimates by the rules of BOP'19."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from foundpose.bop.dataset import BopDataset
from foundpose.bop.errors import ModelErrors
from foundpose.bop.files import BopError
from foundpose.bop.localization import Localization, localization
from foundpose.bop.matching import greedy_matches
from foundpose.bop.results import PoseResult
from foundpose.bop.scores import AVERAGED, FunctionScores, Recall, Scores
from foundpose.bop.targets import Target, describe_target
from foundpose.bop.vsd_image import DepthImage, DepthObject, PosedObject, vsd_of_pairs
from foundpose.rendering.mesh_files import read_mesh_file
from foundpose.utils.units import check_unit

FRACTIONS = tuple(0.05 + 0.05 * k for k in range(10))  # to the last bit those of the toolkit
"""Thresholds of MSSD in diameters, of VSD, and VSD's misalignment tolerances in diameters."""

THRESHOLDS = {
    "mssd": FRACTIONS,
    "mspd": tuple(5.0 * k for k in range(1, 11)),
    "vsd": FRACTIONS,
    "add_s": (0.02, 0.05, 0.1),
}
UNITS = {
    "mssd": "diameters of the object",
    "mspd": "pixels of an image 640 px wide",
    "vsd": "shares of the visible pixels",
    "add_s": "diameters of the object",
}

Progress = Callable[[str, int, int], None]

_PAIRS_PER_STEP = 4096
_TARGETS_PER_STEP = 1024


def score_results(
    dataset: BopDataset,
    results: Sequence[PoseResult],
    errors: Sequence[str] = AVERAGED,
    targets: Sequence[Target] | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Scores:
    """Recall of estimates on the targets of a dataset: the numbers that BOP's toolkit gives.

    Per target the ``inst_count`` best scored estimates are matched greedily to the ``inst_count`` most visible
    annotations; an error counts as correct if it is below the threshold. A recall is the share of all instances,
    of whatever object, that were found; AR is its mean over the thresholds. Targets without estimate count as
    missed, estimates outside the targets are ignored. Targets of bop24 are turned into such of localisation, see
    :meth:`BopDataset.localization_targets`; their own score is :func:`~foundpose.bop.score_pose_detections`.

    Args:
        dataset: the dataset, with ground truth and the models for evaluation.
        results: the estimates, in the order in which equal scores are taken.
        errors: which to compute of ``mssd``, ``mspd``, ``vsd`` and ``add_s`` (ADI for objects with symmetries, ADD
            for others). ``vsd`` is left out, and the scores say so, unless every image of the targets has depth.
        targets: the part of the dataset's targets to look at; all by default.
        device: where errors are computed, in float64. VSD's rays are cast on the CPU.
        progress: called with a stage, what is done of it, and its total.

    Returns:
        The scores.

    Raises:
        ValueError: an unknown error function.
        BopError: no ground truth, no models for evaluation, no targets.
        UnitError: meshes, poses, estimates or depth are not in one unit.
        FileNotFoundError: a file of the dataset is missing.

    Differentiable w.r.t. nothing.
    Source: Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", section 2.
    """
    check_functions(errors)
    if not dataset.has_evaluation_models():
        raise BopError(
            f"{dataset.models_eval} holds no models_info.json: errors need the models for evaluation"
        )
    tables = localization(dataset, results, targets)
    _check_units(dataset, tables)
    not_computed = {name: "not asked for" for name in AVERAGED if name not in errors}
    computed: dict[str, Tensor] = {}
    wanted = [name for name in THRESHOLDS if name in errors and name != "vsd"]
    if wanted:
        computed = model_errors(dataset, tables, wanted, device, progress)
    if "vsd" in errors:
        blind = sum(not dataset.has_depth(*image) for image in tables.images)
        if blind:
            not_computed["vsd"] = f"no depth image for {blind} of {len(tables.images)} images with targets"
        else:
            computed["vsd"] = vsd_errors(dataset, tables, device, progress)
    functions = {name: _recalls(name, computed[name], tables) for name in THRESHOLDS if name in computed}
    counts = _per_object((tables.annotations >= 0).sum(1), tables)
    facts = _facts(dataset, tables, results)
    if "vsd" in functions:
        facts["vsd_delta"] = dataset.vsd_delta
    instances = dict(zip(tables.object_ids, counts.tolist(), strict=True))
    return Scores(facts, instances, functions, not_computed)


def _check_units(dataset: BopDataset, tables: Localization) -> None:
    """Raise UnitError where poses and meshes, or estimates and truth, are hardly in one unit."""
    if not len(tables.T_true):
        return
    diameters = [float(dataset.evaluation_info(obj_id)["diameter"]) for obj_id in tables.object_ids]
    true = float(tables.T_true[:, :3, 3].norm(dim=1).median())
    size = 10.0 * float(torch.tensor(diameters).median())
    # A camera sees objects from between a tenth of a diameter and a thousand.
    check_unit(
        true, f"the median distance in {dataset.split}", size, "ten times the diameter in models_info.json"
    )
    if len(tables.T_est):
        estimated = float(tables.T_est[:, :3, 3].norm(dim=1).median())
        check_unit(estimated, "the median distance of the estimates", true, "that of the ground truth")


def check_functions(errors: Sequence[str]) -> None:
    """Raise ValueError unless these are names of error functions, at least one."""
    if not errors or not set(errors) <= set(THRESHOLDS):
        raise ValueError(f"errors must be some of {', '.join(THRESHOLDS)}, got {list(errors)}")


def model_errors(
    dataset: BopDataset,
    tables: Localization,
    names: Sequence[str],
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> dict[str, Tensor]:
    """Errors of all pairs as multiples of their thresholds' unit: MSSD and ADD(-S) in diameters, MSPD scaled.

    Args:
        dataset: the dataset.
        tables: targets, estimates and annotations.
        names: which of ``mssd``, ``mspd`` and ``add_s``.
        device: where to compute.
        progress: called after each step.

    Returns:
        By name, (N, n, g) float64 on the CPU; infinite where there is no pair.
    """
    pairs = tables.pairs()
    K = torch.stack([dataset.intrinsics(*image) for image in tables.images])
    widths = torch.tensor([dataset.image_size(*image)[1] for image in tables.images], dtype=torch.float64)
    errors = {name: _empty_table(tables) for name in names}
    done = 0
    for index, obj_id in enumerate(tables.object_ids):
        mine = pairs[tables.object[pairs[:, 0]] == index]
        if not len(mine):
            continue
        vertices = torch.from_numpy(read_mesh_file(dataset.evaluation_mesh_path(obj_id)).vertices)
        model = ModelErrors.from_models_info(vertices, dataset.evaluation_info(obj_id)).to(device)
        for part in mine.split(_PAIRS_PER_STEP):
            target, i, j = part.T
            image = tables.image[target]
            T_est = tables.T_est[tables.estimates[target, i]].to(device)
            T_true = tables.T_true[tables.annotations[target, j]].to(device)
            values: dict[str, Tensor] = {}
            if "mssd" in names or "mspd" in names:
                surface, projection = (e.cpu() for e in model(T_est, T_true, K[image].to(device)))
                values = {"mssd": surface / model.diameter, "mspd": projection * (640.0 / widths[image])}
            if "add_s" in names:
                values["add_s"] = model.add_s(T_est, T_true).cpu() / model.diameter
            for name in names:
                errors[name][target, i, j] = values[name]
            done += len(part)
            if progress is not None:
                progress("pose errors", done, len(pairs))
    return errors


def vsd_errors(
    dataset: BopDataset,
    tables: Localization,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Tensor:
    """VSD of all pairs, image by image.

    Args:
        dataset: the dataset, with depth for every image.
        tables: targets, estimates and annotations.
        device: where depth images are compared.
        progress: called after each image.

    Returns:
        (N, taus, n, g) float64 on the CPU; infinite where there is no pair.
    """
    errors = _empty_table(tables)[:, None].repeat(1, len(FRACTIONS), 1, 1)
    objects: dict[int, DepthObject] = {}
    pairs = tables.pairs()
    pairs = pairs[tables.image[pairs[:, 0]].argsort(stable=True)]
    images, counts = torch.unique_consecutive(tables.image[pairs[:, 0]], return_counts=True)
    for done, (image, part) in enumerate(
        zip(images.tolist(), pairs.split(counts.tolist()), strict=True), start=1
    ):
        target, i, j = part.T
        sides = []
        for index, poses in (
            (tables.estimates[target, i], tables.T_est),
            (tables.annotations[target, j], tables.T_true),
        ):
            used, place = torch.unique(index, return_inverse=True)
            owner = torch.empty_like(used).scatter(0, place, tables.object[target])
            posed = []
            for k, pose in zip(owner.tolist(), poses[used], strict=True):
                if k not in objects:
                    objects[k] = _depth_object(dataset, tables.object_ids[k])
                posed.append(PosedObject(objects[k], pose))
            sides.append((posed, place))
        (estimates, est_place), (truths, true_place) = sides
        where = tables.images[image]
        seen = DepthImage(dataset.depth(*where), dataset.intrinsics(*where))
        distance = float(torch.stack([posed.T_camera_from_model[2, 3] for posed in truths]).median())
        if bool((seen.depth > 0).any()):
            measured = float(seen.depth[seen.depth > 0].median())
            name = f"the median depth of {describe_target(*where)} with its depth_scale"
            check_unit(measured, name, distance, "that of its objects")
        places = torch.stack([est_place, true_place], dim=1)
        errors[target, :, i, j] = vsd_of_pairs(
            estimates, truths, places, seen, FRACTIONS, dataset.vsd_delta, device
        )
        if progress is not None:
            progress("VSD", done, len(images))
    return errors


def _depth_object(dataset: BopDataset, obj_id: int) -> DepthObject:
    mesh = read_mesh_file(dataset.evaluation_mesh_path(obj_id))
    diameter = float(dataset.evaluation_info(obj_id)["diameter"])
    return DepthObject(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces), diameter)


def _empty_table(tables: Localization) -> Tensor:
    shape = (*tables.estimates.shape, tables.annotations.shape[1])
    return torch.full(shape, torch.inf, dtype=torch.float64)


def _recalls(name: str, errors: Tensor, tables: Localization) -> FunctionScores:
    """Match (N, [taus,] n, g) errors at all thresholds and count."""
    thresholds = torch.tensor(THRESHOLDS[name], dtype=torch.float64)
    steps = errors.split(_TARGETS_PER_STEP)
    found = _per_object(torch.cat([(greedy_matches(e, thresholds) >= 0).sum(-1) for e in steps]), tables)
    targets = _per_object((tables.annotations >= 0).sum(1), tables)
    objects = {obj_id: Recall(found[k], int(targets[k])) for k, obj_id in enumerate(tables.object_ids)}
    total = Recall(found.sum(0), int(targets.sum()))
    taus = list(FRACTIONS) if name == "vsd" else None
    return FunctionScores(list(THRESHOLDS[name]), UNITS[name], total, objects, taus)


def _per_object(counts: Tensor, tables: Localization) -> Tensor:
    """Sums (O, ...) of the targets' counts (N, ...)."""
    return counts.new_zeros(len(tables.object_ids), *counts.shape[1:]).index_add(0, tables.object, counts)


def _facts(dataset: BopDataset, tables: Localization, results: Sequence[PoseResult]) -> dict[str, Any]:
    used = (tables.estimates >= 0).sum(1)
    annotated = (tables.annotations >= 0).sum(1)
    facts: dict[str, Any] = {
        "dataset": dataset.root.resolve().name,
        "split": dataset.split.name,
        "targets_file": dataset.targets_path.name,
        "task": "6D localization, rules of BOP'19",
        "images": len(tables.images),
        "targets": int(annotated.sum()),
        "estimates_in_file": len(results),
        "estimates_used": int(used.sum()),
        "target_instances_without_estimate": int((tables.inst_count - used).sum()),
        "target_instances_without_annotation": int((tables.inst_count - annotated).sum()),
        "estimates_outside_targets": tables.outside,
        "average_time_per_image": _average_time(results, set(tables.images)),
    }
    if any(target.obj_id is None for target in dataset.targets()):
        facts["task"] = (
            "localization recall on targets derived from the ground truth; detection_6d has the AP of 6D detection"
        )
    return facts


def _average_time(results: Sequence[PoseResult], images: set[tuple[int, int]]) -> float | None:
    """Mean over the targets' images that have estimates; None where one was not timed."""
    times: dict[tuple[int, int], float] = {}
    for result in results:
        image = (result.scene_id, result.im_id)
        if image in images:
            times[image] = max(result.time, times.get(image, result.time))
    timed = bool(times) and all(time >= 0 for time in times.values())
    return sum(times.values()) / len(times) if timed else None

"""Estimates as plain records: what is written to JSON and to BOP's results file."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import torch

from foundpose.bop import Instance, PoseResult, Target, best_of_targets
from foundpose.estimates import PoseEstimates, PoseStatus


def pose_records(estimates: PoseEstimates) -> list[dict[str, Any]]:
    """One record per estimate, of numbers and lists that JSON can hold.

    Args:
        estimates: poses of B crops, on any device (read field by field, not crop by crop).

    Returns:
        B records: ``valid``, ``status`` (name), ``score``, ``num_inliers``, ``num_patches`` of the crop, ``R`` (3
        rows) and ``t`` (mesh units) of the pose in the camera's frame, ``templates`` with their ``similarities``, and
        the ``best`` of them.
    """
    T = estimates.T_camera_from_model.double().cpu()
    columns = {
        "valid": estimates.valid.tolist(),
        "status": [PoseStatus(code).name for code in estimates.status.tolist()],
        "score": estimates.score.tolist(),
        "num_inliers": estimates.num_inliers.tolist(),
        "num_patches": estimates.query.valid.sum(dim=1).tolist(),
        "R": T[:, :3, :3].tolist(),
        "t": T[:, :3, 3].tolist(),
        "templates": estimates.templates.index.tolist(),
        "similarities": estimates.templates.similarity.nan_to_num(neginf=-1.0).tolist(),
        "best": estimates.best.tolist(),
    }
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def instance_record(instance: Instance) -> dict[str, Any]:
    """Which region of which image a pose was estimated for, with the detector's score and time."""
    return {
        "scene_id": instance.scene_id,
        "im_id": instance.im_id,
        "obj_id": instance.obj_id,
        "detection_score": instance.score,
        "detection_time": instance.time,
    }


def add_image_times(records: Sequence[dict[str, Any]]) -> None:
    """Set every record's ``time``: the seconds of its whole image, as BOP wants them.

    That is the detector's time of the image and the ``seconds`` of all its records.
    """
    estimation: dict[tuple[int, int], float] = defaultdict(float)
    detection: dict[tuple[int, int], float] = defaultdict(float)
    for record in records:
        key = (record["scene_id"], record["im_id"])
        estimation[key] += record["seconds"]
        detection[key] = max(detection[key], record["detection_time"])
    for record in records:
        key = (record["scene_id"], record["im_id"])
        record["time"] = estimation[key] + detection[key]


def to_results(records: Sequence[dict[str, Any]]) -> list[PoseResult]:
    """Lines of BOP's results file; estimates that failed are left out."""
    results = []
    for record in records:
        if record["valid"]:
            T = torch.eye(4, dtype=torch.float64)
            T[:3, :3] = torch.tensor(record["R"], dtype=torch.float64)
            T[:3, 3] = torch.tensor(record["t"], dtype=torch.float64)
            ids = (record["scene_id"], record["im_id"], record["obj_id"])
            results.append(PoseResult(*ids, record["score"], T, record["time"]))
    return results


def best_results(results: Sequence[PoseResult], targets: Iterable[Target]) -> list[PoseResult]:
    """As many results of each target as it has instances, those of highest score, in the order given."""
    keys = [(result.scene_id, result.im_id, result.obj_id) for result in results]
    kept = best_of_targets(keys, [result.score for result in results], targets)
    return [results[i] for i in kept]

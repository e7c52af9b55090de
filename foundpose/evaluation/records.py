"""Estimates as plain records: what is written to JSON and to BOP's results file."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from foundpose.bop import Instance, PoseResult
from foundpose.geometry import make_transform
from foundpose.pipeline.results import PoseEstimates, PoseEvidence, PoseStatus


def pose_records(estimates: PoseEstimates) -> list[dict[str, Any]]:
    """One record per estimate, of numbers and lists that JSON can hold.

    Args:
        estimates: poses of B crops, on any device (read at once).

    Returns:
        B records: ``valid``, ``status`` (name), ``score``, ``num_inliers``, ``num_patches`` of the crop, ``R`` (3
        rows) and ``t`` (mesh units) of the pose in the camera's frame, ``templates`` with their ``similarities``, and
        the ``best`` of them; with a confidence the ``probability`` that the pose is right, and its ``evidence``.
    """
    T, templates = estimates.T_camera_from_model, estimates.templates
    fields = [
        estimates.valid,
        estimates.status,
        estimates.score,
        estimates.num_inliers,
        estimates.query.valid.sum(dim=1),
        estimates.best,
        T[:, :3, :3].flatten(1),
        T[:, :3, 3],
        templates.index,
        templates.similarity.nan_to_num(neginf=-1.0),
    ]
    # One transfer; double precision holds all of these numbers as they are.
    rows = torch.cat([x.detach().double().reshape(len(T), -1) for x in fields], dim=1).cpu()
    h = templates.index.shape[1]
    valid, status, score, num_inliers, num_patches, best, R, t, index, similarity = rows.split(
        [1, 1, 1, 1, 1, 1, 9, 3, h, h], dim=1
    )
    columns = {
        "valid": valid.squeeze(1).bool().tolist(),
        "status": [PoseStatus(int(code)).name for code in status.squeeze(1)],
        "score": score.squeeze(1).tolist(),
        "num_inliers": num_inliers.squeeze(1).long().tolist(),
        "num_patches": num_patches.squeeze(1).long().tolist(),
        "R": R.unflatten(1, (3, 3)).tolist(),
        "t": t.tolist(),
        "templates": index.long().tolist(),
        "similarities": similarity.tolist(),
        "best": best.squeeze(1).long().tolist(),
    }
    if estimates.probability is not None and estimates.evidence is not None:
        columns["probability"] = estimates.probability.tolist()
        evidence = torch.stack(estimates.evidence, dim=1).tolist()
        columns["evidence"] = [dict(zip(PoseEvidence._fields, row, strict=True)) for row in evidence]
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
            ids = (record["scene_id"], record["im_id"], record["obj_id"])
            results.append(PoseResult(*ids, record["score"], pose_of(record), record["time"]))
    return results


def pose_of(record: Mapping[str, Any]) -> Tensor:
    """``T_camera_from_model`` (4, 4) float64 of a record."""
    R, t = (torch.tensor(record[name], dtype=torch.float64) for name in ("R", "t"))
    return make_transform(R, t)

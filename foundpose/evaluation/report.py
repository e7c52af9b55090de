"""What an evaluation leaves behind: all estimates, and where the time went."""

import platform
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from foundpose.bop import BopDataset, Instance, PoseResult, Target
from foundpose.bop.targets import describe_target
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import add_image_times
from foundpose.evaluation.shards import BatchRecord, read_shards
from foundpose.pipeline import FoundPose
from foundpose.pipeline.results import PoseStatus


class Estimated(NamedTuple):
    """What an evaluation estimated.

    Attributes:
        dataset: the dataset.
        pictures: makes the picture of an image.
        objects: meshes and representations.
        pipeline: the method.
        device: where it computes.
        instances: the masks, one for each record.
        records: the estimates.
    """

    dataset: BopDataset
    pictures: Callable[[BopDataset, int, int], Tensor]
    objects: DatasetObjects
    pipeline: FoundPose
    device: torch.device
    instances: Sequence[Instance]
    records: list[dict[str, Any]]


def merge_shards(folder: Path, batches: Sequence[Sequence[Instance]]) -> list[BatchRecord]:
    """All batches of a finished run, in the plan's order.

    Raises:
        ValueError: batches are missing, or the shards do not fit the plan.
    """
    done = read_shards(folder, batches)
    missing = [i for i in range(len(batches)) if i not in done]
    if missing:
        raise ValueError(
            f"{len(missing)} of {len(batches)} batches are not in {folder / 'shards'} (first: {missing[0]}); start "
            "the run again to estimate them"
        )
    return list(done.values())


def all_records(batches: Sequence[BatchRecord]) -> list[dict[str, Any]]:
    """Records of all instances, with the time of their image, sorted by scene, image and object.

    Records of one object in one image keep the order of their detections.
    """
    records = [record for batch in batches for record in batch.records]
    add_image_times(records)
    return sorted(records, key=lambda record: (record["scene_id"], record["im_id"], record["obj_id"]))


def unanswered(
    targets: Sequence[Target], results: Sequence[PoseResult], records: Sequence[dict[str, Any]] | None
) -> list[dict[str, Any]]:
    """Targets with fewer estimates than instances.

    Args:
        targets: what was to be found.
        results: the estimates.
        records: what became of every detection; None where the estimates came from a file.

    Returns:
        For each its ids, the number of ``instances`` without estimate, and the ``reason``. A target that is an image
        (bop24) is one instance.
    """
    found: Counter[tuple[int, int, int | None]] = Counter()
    for result in results:
        found.update([(result.scene_id, result.im_id, result.obj_id), (result.scene_id, result.im_id, None)])
    states: dict[tuple[int, int, int | None], list[str]] = defaultdict(list)
    for record in records or ():
        for obj_id in (record["obj_id"], None):
            states[record["scene_id"], record["im_id"], obj_id].append(record["status"])
    missing = []
    for target in targets:
        instances = (target.inst_count or 1) - found[target[:3]]
        if instances <= 0:
            continue
        tried = states[target[:3]]
        failed = sorted({status for status in tried if status != PoseStatus.OK.name})
        if records is None:
            reason = "not in the results file"
        elif failed:
            reason = f"no pose ({', '.join(failed)})"
        else:
            reason = "too few detections" if tried else "no detection"
        ids = dict(zip(("scene_id", "im_id", "obj_id"), target[:3], strict=True))
        missing.append(ids | {"instances": instances, "reason": reason})
    return missing


def in_words(missing: Sequence[dict[str, Any]], most: int = 3) -> str:
    """A line for each reason of :func:`unanswered`, with the first few targets."""
    if not missing:
        return "every target has its estimates"
    by_reason: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in missing:
        by_reason[entry["reason"]].append(entry)
    lines = []
    for reason, entries in by_reason.items():
        names = [describe_target(e["scene_id"], e["im_id"], e["obj_id"]) for e in entries[:most]]
        more = f" and {len(entries) - most} more" if len(entries) > most else ""
        count = sum(entry["instances"] for entry in entries)
        lines.append(f"{count} instances without estimate, {reason}: {', '.join(names)}{more}")
    return "\n".join(lines)


def timing(batches: Sequence[BatchRecord], device: torch.device | str) -> dict[str, Any]:
    """Seconds by stage, in total and per instance, and on what.

    ``pipeline`` is the whole of the method and ``other`` what its stages leave of it; ``waiting`` is the time that
    a process stood still for images, ``representations`` that of loading objects. All processes are added up;
    ``device`` and ``threads`` are those of the process that asks.
    """
    seconds: dict[str, float] = defaultdict(float)
    for batch in batches:
        for name, value in batch.seconds.items():
            seconds[name] += value
    outside = ("pipeline", "waiting", "representations")
    stages = {name: value for name, value in seconds.items() if name not in outside}
    if stages:
        seconds["other"] = seconds["pipeline"] - sum(stages.values())
    instances = sum(len(batch.records) for batch in batches)
    images = {(r["scene_id"], r["im_id"]) for batch in batches for r in batch.records}
    device = torch.device(device)
    on_gpu = device.type == "cuda"
    return {
        "seconds": dict(seconds),
        "seconds_per_instance": {name: value / max(instances, 1) for name, value in seconds.items()},
        "instances": instances,
        "images": len(images),
        "batches": len(batches),
        "device": torch.cuda.get_device_name(device)
        if on_gpu
        else platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }

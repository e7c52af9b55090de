"""What an evaluation leaves behind: all estimates, and where the time went."""

import platform
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from foundpose.bop import Instance
from foundpose.evaluation.records import add_image_times
from foundpose.evaluation.shards import BatchRecord, read_shards


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

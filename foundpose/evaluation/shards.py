"""Estimates on disk while an evaluation runs: one file for each process, to which whole batches are appended."""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock

from foundpose.bop import Instance
from foundpose.evaluation.records import instance_record
from foundpose.utils.files import write_json


class BatchRecord(NamedTuple):
    """A finished batch.

    Attributes:
        number: place of the batch in the plan.
        records: one for each of its instances: which one it is, and its pose.
        seconds: time of each stage for the whole batch.
    """

    number: int
    records: list[dict[str, Any]]
    seconds: dict[str, float]


def shard_path(folder: Path, rank: int) -> Path:
    """File of a process."""
    return folder / "shards" / f"rank-{rank:05d}.jsonl"


class ShardWriter:
    """Appends batches to a process's shard, one line of JSON for each.

    A batch is there when its line is whole: what an interruption left of a line is cut off before the next is
    written, and readers ignore it.

    Args:
        folder: the run's folder.
        rank: number of the process.
    """

    def __init__(self, folder: Path, rank: int) -> None:
        self.path = shard_path(folder, rank)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as file:
            file.seek(0)
            whole = file.read().rfind(b"\n") + 1
            file.truncate(whole)

    def append(self, batch: BatchRecord) -> None:
        """Write a batch through to the disk."""
        line = json.dumps(batch._asdict()) + "\n"
        with self.path.open("ab") as file:
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())


def read_shards(folder: Path, batches: Sequence[Sequence[Instance]]) -> dict[int, BatchRecord]:
    """Finished batches of a run, of all its processes.

    Args:
        folder: the run's folder.
        batches: the plan, which must be the one that the run began with.

    Returns:
        Batches by number, ascending. One that was written twice (which takes two runs in one folder at a time)
        counts once.

    Raises:
        ValueError: a shard is damaged, or belongs to another plan.
    """
    found: dict[int, BatchRecord] = {}
    for path in sorted((folder / "shards").glob("rank-*.jsonl")):
        whole, _, _ = path.read_bytes().rpartition(b"\n")
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                batch = BatchRecord(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise ValueError(
                    f"{path}, line {number} is damaged ({error}); delete the line to estimate its batch again"
                ) from error
            _check_plan(path, batch, batches)
            found.setdefault(batch.number, batch)
    return dict(sorted(found.items()))


def _check_plan(path: Path, batch: BatchRecord, batches: Sequence[Sequence[Instance]]) -> None:
    """Raise ValueError unless a batch has the instances that the plan gives it."""
    planned = [instance_record(i) for i in batches[batch.number]] if batch.number < len(batches) else []
    if len(planned) == len(batch.records) and all(
        expected.items() <= record.items() for expected, record in zip(planned, batch.records, strict=True)
    ):
        return
    raise ValueError(
        f"batch {batch.number} in {path} has other instances than the targets and masks of now: the dataset's files "
        "have changed since the run began; give another hydra.run.dir"
    )


def keep_batch_size(folder: Path, measure: Callable[[], int]) -> None:
    """Measure the size of a run's batches and record it in its folder, unless it is there."""
    path = _batch_size_path(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Where nodes have file systems of their own for representations, several processes come here.
    with FileLock(path.with_suffix(".lock")):
        if not path.is_file():
            write_json(path, {"batch_size": measure()})


def read_batch_size(folder: Path) -> int:
    """The size of batches that a run's folder records.

    Raises:
        RuntimeError: none yet.
        ValueError: the record is damaged.
    """
    path = _batch_size_path(folder)
    if not path.is_file():
        raise RuntimeError(f"batch_size='auto' is found out when a run starts, and {path} is not there yet")
    try:
        size = json.loads(path.read_text())["batch_size"]
        if not isinstance(size, int) or size < 1:
            raise ValueError(f"batch_size is {size!r}")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}); delete it, and the folder's shards, to start anew"
        ) from error
    return size


def _batch_size_path(folder: Path) -> Path:
    return folder / "batch_size.json"

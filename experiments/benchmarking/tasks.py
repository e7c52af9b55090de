"""What is measured, and how a list of it is worked off."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from benchmarking.measure import Measurement, MeasureSettings, count_host_syncs, measure
from foundpose.onboarding import Progress


@dataclass(frozen=True)
class Task:
    """A call to be measured.

    Attributes:
        group: section of the table.
        name: of the row.
        call: what to run.
        batch_size: number of crops or templates in it; None where that means nothing.
        units: what the time is divided by.
        unit: what that is, "crop", "template" or "object".
        gradient: the call needs autograd; others run in inference mode.
        once: the call is too long to be repeated.
        projected: the number of units that a whole object has, to project the time to.
        note: on the row.
        facts: further figures, written as they are.
    """

    group: str
    name: str
    call: Callable[[], object]
    batch_size: int | None = None
    units: int = 1
    unit: str = "crop"
    gradient: bool = False
    once: bool = False
    projected: int | None = None
    note: str = ""
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """A measured task; times in seconds, memory in bytes.

    Attributes:
        group: section of the table.
        name: of the row.
        batch_size: number of crops or templates in a call.
        units: what the time per unit is divided by.
        unit: what that is.
        median: of a call.
        lower: first quartile.
        upper: third quartile.
        calls: number of calls timed.
        per_unit: median by unit.
        memory_rise: by how much the peak exceeds what was in use before; None where it cannot be told.
        memory_peak: all that was in use at the peak.
        memory_reason: why there is none.
        host_syncs: how often the call made the host wait for the GPU; None on other devices.
        projected: the time that a whole object would take at this speed.
        note: on the row.
        facts: further figures.
    """

    group: str
    name: str
    batch_size: int | None
    units: int
    unit: str
    median: float
    lower: float
    upper: float
    calls: int
    per_unit: float
    memory_rise: int | None
    memory_peak: int | None
    memory_reason: str | None
    host_syncs: int | None
    projected: float | None
    note: str
    facts: dict[str, Any]


def run_tasks(
    tasks: Sequence[Task],
    device: torch.device,
    settings: MeasureSettings,
    progress: Progress,
    stage: str | None = None,
) -> list[Row]:
    """Measure tasks one after another.

    Args:
        tasks: what to measure.
        device: where they run.
        settings: how often each is repeated.
        progress: is told after each.
        stage: what to call them all in the progress; None for the group of the first.
    """
    if not tasks:
        return []
    stage = stage or tasks[0].group
    rows = []
    progress(stage, 0, len(tasks))
    for done, task in enumerate(tasks, 1):
        rows.append(_row(task, *run_task(task, device, settings)))
        progress(stage, done, len(tasks))
    return rows


def run_task(task: Task, device: torch.device, settings: MeasureSettings) -> tuple[Measurement, int | None]:
    """Measure one task, and count on a GPU how often it makes the host wait (in a call of its own)."""
    with torch.inference_mode(not task.gradient):
        measured = measure(task.call, device, settings.once() if task.once else settings)
        counted = device.type == "cuda" and not task.once
        return measured, count_host_syncs(task.call) if counted else None


def _row(task: Task, measured: Measurement, host_syncs: int | None) -> Row:
    per_unit = measured.median / task.units
    same = ("group", "name", "batch_size", "units", "unit", "note", "facts")
    return Row(
        **{name: getattr(task, name) for name in same},
        **{name: getattr(measured, name) for name in ("median", "lower", "upper", "calls")},
        per_unit=per_unit,
        memory_rise=measured.memory.rise,
        memory_peak=measured.memory.peak,
        memory_reason=measured.memory.reason,
        host_syncs=host_syncs,
        projected=None if task.projected is None else per_unit * task.projected,
    )

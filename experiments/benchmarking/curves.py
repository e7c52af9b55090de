"""Scaling: the time of stages against one size at a time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from benchmarking.inference import (
    COARSE,
    REFINE_ONE,
    REFINED,
    Stages,
    pipeline_tasks,
    pnp_name,
    refine_all_name,
    stage_tasks,
)
from benchmarking.measure import MeasureSettings
from benchmarking.sizes import WorkloadSizes
from benchmarking.tasks import Task, run_tasks
from benchmarking.workload import Workload, make_workload, subset, with_crops
from foundpose.onboarding import Progress

AXES = {
    "batch": "batch size (crops)",
    "templates": "templates",
    "words": "visual words",
    "patches": "patches per crop and template",
    "hypotheses": "retrieved templates (hypotheses)",
    "ransac_iterations": "RANSAC iterations",
    "lm_iterations": "Levenberg-Marquardt iterations",
}
"""Curves that there are, and what is varied."""


class StageFactory(Protocol):
    """Makes stages for a workload; a setting that is None keeps its configured value."""

    def __call__(
        self,
        sizes: WorkloadSizes,
        hypotheses: int | None = None,
        ransac_iterations: int | None = None,
        lm_iterations: int | None = None,
        stop_early: bool = True,
    ) -> Stages:
        """Stages; without ``stop_early`` RANSAC and Levenberg-Marquardt make all their iterations."""


@dataclass(frozen=True)
class Point:
    """One measured point of a curve; times in seconds per crop.

    Attributes:
        x: the size that is varied.
        median: of the calls.
        lower: first quartile.
        upper: third quartile.
        calls: number of calls timed.
    """

    x: int
    median: float
    lower: float
    upper: float
    calls: int


@dataclass(frozen=True)
class Curve:
    """Times against one size.

    Attributes:
        name: key of ``AXES``.
        series: points of each stage, by its name.
        batch_size: number of crops in a call; None where that is what varies.
    """

    name: str
    series: dict[str, list[Point]]
    batch_size: int | None


def measure_curves(
    workload: Workload,
    factory: StageFactory,
    values: Mapping[str, Sequence[int]],
    crops_per_image: int,
    device: torch.device,
    settings: MeasureSettings,
    progress: Progress,
) -> list[Curve]:
    """Vary one size at a time.

    Args:
        workload: the standard one, from which the others are derived.
        factory: makes stages.
        values: sizes of each curve, by the keys of ``AXES``; a curve without any is left out.
        crops_per_image: of the workloads with other batch sizes.
        device: where the work is done.
        settings: how often each point is measured.
        progress: is told of every point.

    Raises:
        ValueError: an unknown curve.
    """
    unknown = sorted(set(values) - set(AXES))
    if unknown:
        raise ValueError(f"there is no curve {unknown[0]!r}; choose from {list(AXES)}")
    curves = []
    for name, xs in values.items():
        if not xs:
            continue
        series: dict[str, list[Point]] = {}
        progress(f"curve {name}", 0, len(xs))
        for done, x in enumerate(xs, 1):
            for label, task in _tasks(name, x, workload, factory, crops_per_image):
                (row,) = run_tasks([task], device, settings, _silent)
                point = Point(x, row.per_unit, row.lower / row.units, row.upper / row.units, row.calls)
                series.setdefault(label, []).append(point)
            progress(f"curve {name}", done, len(xs))
        batch_size = None if name == "batch" else workload.sizes.batch_size
        curves.append(Curve(name, series, batch_size))
    return curves


def _tasks(
    name: str, x: int, workload: Workload, factory: StageFactory, crops_per_image: int
) -> Iterator[tuple[str, Task]]:
    """What is measured at a point, with the label of its line."""
    sizes = workload.sizes
    h = factory(sizes).retriever.num_templates
    if name == "batch":
        given = with_crops(workload, x, -(-x // crops_per_image))
        wanted = ["crop", "retrieval", "matching", pnp_name(h), REFINE_ONE, COARSE, REFINED]
        yield from _choose(factory(given.sizes), given, wanted)
    elif name in ("templates", "words", "patches"):
        given = _resized(workload, name, x)
        wanted = {
            "templates": ["retrieval", COARSE],
            "words": ["words and bag of words", "retrieval", COARSE],
            "patches": ["retrieval", "matching", pnp_name(h), REFINE_ONE, COARSE],
        }[name]
        yield from _choose(factory(given.sizes), given, wanted)
    elif name == "hypotheses":
        labels = {
            "template gather": "template gather",
            "matching": "matching",
            pnp_name(x): "PnP of all hypotheses",
            COARSE: COARSE,
            refine_all_name(x): "refinement of all hypotheses",
        }
        chosen = _choose(factory(sizes, hypotheses=x), workload, list(labels))
        yield from ((labels[label], task) for label, task in chosen)
    elif name == "ransac_iterations":
        for stop, suffix in ((True, ", stopped when confident"), (False, ", all samples")):
            stages = factory(sizes, ransac_iterations=x, stop_early=stop)
            chosen = _choose(stages, workload, [pnp_name(h)])
            yield from ((label + suffix, task) for label, task in chosen)
    else:
        for stop, suffix in ((True, ", stopped when converged"), (False, ", all iterations")):
            stages = factory(sizes, lm_iterations=x, stop_early=stop)
            chosen = _choose(stages, workload, [REFINE_ONE])
            yield from ((label + suffix, task) for label, task in chosen)


def _choose(stages: Stages, workload: Workload, wanted: list[str]) -> Iterator[tuple[str, Task]]:
    refine_all = any(name == refine_all_name(stages.retriever.num_templates) for name in wanted)
    tasks = stage_tasks(stages, workload, {}, "curves", refine_all)
    if COARSE in wanted or REFINED in wanted:
        tasks += pipeline_tasks(stages, workload, None, "curves", judge=False)
    return ((task.name, task) for task in tasks if task.name in wanted)


def _resized(workload: Workload, name: str, x: int) -> Workload:
    """A workload with another number of templates, words or patches."""
    before = workload.sizes
    if name == "templates":
        sizes = replace(before, templates=x)
    elif name == "words":
        sizes = replace(before, words=x)
    else:
        sizes = replace(before, patches=x)
    if sizes == before:
        return workload
    if name == "templates" and x < before.templates:
        return workload._replace(representation=subset(workload.representation, x))
    return make_workload(sizes, workload.features.device).to(workload.features.dtype)


def _silent(stage: str, done: int, total: int) -> None:
    """Tell nobody."""

"""The report over all runs of a sweep: a sortable table of runs, recall curves, and recalls by object."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ablation.records import RunRecord, varied_settings
from ablation.units import unit_of
from foundpose.visualization.report import Cell, Report, lines_chart, write_report

_ERRORS = ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD")
_FIGURES = (*_ERRORS, "targets", "time_per_image", "memory.total")
_MOST_LINES = 12


def write_runs_page(records: Sequence[RunRecord], path: Path) -> None:
    """Write the report of runs; those that failed come first, then the lowest recall.

    Args:
        records: the runs.
        path: of the HTML file.
    """
    varied = [
        key for key in varied_settings(list(records)) if not key.endswith(("_target_", ".path", ".root"))
    ]
    ordered = sorted(records, key=lambda run: (run.status == "finished", _recall(run)))
    best_first = [(run, _scores(run)) for run in reversed(ordered) if run.counts]
    names = {id(run): _name(run, varied) for run in records}
    tables, charts = {}, {}
    for error in _ERRORS:
        rows: list[dict[str, Cell]] = []
        for run, scores in best_first:
            of_objects = {
                k: v[error] for k, v in scores.get("objects", {}).items() if v.get(error) is not None
            }
            if of_objects:
                rows.append({"run": names[id(run)]} | {f"object {k}": 100 * v for k, v in of_objects.items()})
        tables[f"{error} by object"] = rows
    for error in ("vsd", "mssd", "mspd"):
        computed = [(run, s[error]) for run, s in best_first if s.get(error, {}).get("recalls") is not None]
        flat = {names[id(run)]: _mean_rows(s["recalls"]) for run, s in computed[:_MOST_LINES]}
        if flat:
            found = computed[0][1]
            title = f"Recall under {error.upper()} (the {len(flat)} best runs)"
            charts[title] = lines_chart(found["thresholds"], flat, f"threshold, {found['thresholds_are']}")
    failed = sum(run.status == "failed" for run in records)
    report = Report(
        title=f"{len(records)} runs",
        facts={"finished": str(len(records) - failed), "failed": str(failed)},
        tables=tables,
        charts=charts,
        cases=[_case(run, varied) for run in ordered],
        thumbnails={},
        figures={},
    )
    write_report(path, report)


def _case(run: RunRecord, varied: Sequence[str]) -> dict[str, Cell]:
    case: dict[str, Cell] = {"run": run.name or run.row, "dataset": run.dataset, "status": run.status}
    case |= {key: _cell(run.settings.get(key)) for key in varied}
    for name in _FIGURES:
        value = run.figures.get(name)
        case[name] = None if value is None else value * unit_of(name).factor
    return case | {"note": run.error or run.label}


def _cell(value: Any) -> Cell:
    # Truth values and lists as words.
    return value if isinstance(value, str | float | None) or type(value) is int else json.dumps(value)


def _name(run: RunRecord, varied: Sequence[str]) -> str:
    settings = [f"{key.rpartition('.')[2]}={_cell(run.settings.get(key))}" for key in varied[:3]]
    return " ".join([run.dataset, *([run.name] if run.name else []), *settings])


def _recall(run: RunRecord) -> float:
    """The first recall that a run has."""
    return next((run.figures[name] for name in ("AR", "AR_MSPD") if run.figures.get(name) is not None), 0.0)


def _scores(run: RunRecord) -> dict[str, Any]:
    path = None if run.folder is None else run.folder / "scores.json"
    content: dict[str, Any] = json.loads(path.read_text()) if path is not None and path.is_file() else {}
    return content


def _mean_rows(recalls: list[Any]) -> list[float]:
    """Recalls at each threshold; VSD has them for each of its tolerances, too."""
    if recalls and isinstance(recalls[0], list):
        return [sum(column) / len(column) for column in zip(*recalls, strict=True)]
    return recalls

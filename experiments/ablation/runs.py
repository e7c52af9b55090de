"""Runs one set of settings of a sweep, once, and reports on all that ran: the part of this room that knows Hydra."""

import json
import re
import sys
import traceback
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from ablation.memory import memory_table
from ablation.page import write_runs_page
from ablation.plots import plot_sweep
from ablation.records import RUN_FILE, RunRecord, collect_runs, varied_settings, write_tidy
from ablation.sweeps import SWEEP_FIGURES, sweep_table
from ablation.tables import paper_table
from ablation.text_tables import Format
from foundpose.config import MAY_CHANGE
from foundpose.utils.files import write_text
from foundpose.utils.progress import say
from foundpose.utils.settings import digest

# Keys that say where things lie and what they are called, not what is computed.
_NOT_SETTINGS = (
    "folder",
    "representations",
    "artefacts",
    "results",
    "method",
    "row",
    "report",
    "report_only",
    "progress",
)
# What may be overridden in an experiment that is a row of the paper: it stays that row.
_ROW_MAY_CHANGE = (
    *_NOT_SETTINGS,
    *("experiment", "sweep", "launcher", "hydra"),
    *("data", "masks.path", "objects", "max_images"),
    *("trainer", "device", "data_module", "evaluation", "errors", "memory_limit"),
    *("extractor.weights", "extractor.seed", "extractor.config"),
    *("megapose.weights", "megapose.seed"),
)
_WHOLE_REFERENCE = re.compile(r"\$\{[^}]*\}")
_FORMATS: tuple[tuple[str, Format], ...] = ((".md", "markdown"), (".tex", "latex"))
_NOT_VARIED = ("masks.path", "data.root")


def run_settings(cfg: DictConfig) -> dict[str, Any]:
    """What a run depends on: values by dotted key.

    Nodes that only repeat another one (``${words}``) are left out, and so are places and names.
    """
    literal = OmegaConf.to_container(cfg, resolve=False)
    resolved = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(literal, dict)
    assert isinstance(resolved, dict)
    settings: dict[str, Any] = {}

    def collect(literal: Any, resolved: Any, key: str) -> None:
        if isinstance(literal, str) and _WHOLE_REFERENCE.fullmatch(literal):
            return
        if isinstance(literal, dict) and literal:
            for name, value in literal.items():
                collect(value, resolved[name], f"{key}.{name}" if key else str(name))
        else:
            settings[key] = resolved

    for name, value in literal.items():
        if name not in _NOT_SETTINGS:
            collect(value, resolved[name], str(name))
    return settings


def run_folder(cfg: DictConfig) -> Path:
    """Folder of a run below ``cfg.folder``: the same for the same settings, whatever they are called."""
    kept = {
        key: value
        for key, value in run_settings(cfg).items()
        if not any(key == name or key.startswith(f"{name}.") for name in MAY_CHANGE)
    }
    return Path(cfg.folder) / "runs" / f"{_dataset(cfg)}-{digest(kept)[:12]}"


def run_once(cfg: DictConfig, name: str | None = None, overrides: Sequence[str] = ()) -> RunRecord:
    """Evaluate one set of settings unless that has been done, and record it.

    Args:
        cfg: as ``conf/ablate.yaml``.
        name: of the experiment, for the record.
        overrides: what the user changed in it, as ``key=value``. A row of the paper with other settings is not that
            row any more, and recorded without it.

    Returns:
        The record, which lies in the run's folder as ``run.json``. A run that fails or is killed is recorded too, and
        is tried again the next time, from where it stopped; ``error.txt`` has the whole of a failure's error.

    Raises:
        ValueError: settings that only ``evaluate.py`` knows what to do with.
    """
    _refuse_several_processes(cfg)
    if cfg.results is not None:
        raise ValueError("ablate.py estimates poses; score a file with experiments/evaluate.py results=…")
    folder, settings = run_folder(cfg), run_settings(cfg)
    row = cfg.row if _is_still_the_row(overrides) else None
    if row != cfg.row:
        say(f"not {cfg.row} any more, with {', '.join(overrides)}: recorded without it")
    facts: dict[str, Any] = {"name": name, "row": row, "dataset": _dataset(cfg), "label": _label(settings)}
    if (folder / RUN_FILE).is_file():
        before = RunRecord.read(folder / RUN_FILE)
        if before.status == "finished" and before.settings.get("errors") == settings["errors"]:
            say(f"already there: {folder}")
            if before.row is None and row is not None:
                before = replace(before, name=name, row=row)
                before.write(folder)
            return before
    # If it is killed, this is what is found.
    started = RunRecord(**facts, settings=settings, status="failed", error="it was started and has not ended")
    started.write(folder)
    try:
        # Imported here because Lightning takes its time, and reports do without.
        from foundpose.evaluation.run import run_evaluation

        run_evaluation(cfg, folder)
        record = replace(started, status="finished", error=None, figures=_figures(folder))
        (folder / "error.txt").unlink(missing_ok=True)
    except Exception as error:
        text = traceback.format_exc()
        write_text(folder / "error.txt", text)
        cause = _root_cause(error)
        record = replace(started, error=f"{type(cause).__name__}: {cause}")
        say(f"failed: {folder}: {record.error}")
    record.write(folder)
    return record


def _refuse_several_processes(cfg: DictConfig) -> None:
    trainer = cfg.trainer
    if trainer.strategy != "auto" or trainer.num_nodes != 1 or trainer.devices not in (1, "1"):
        raise ValueError(
            "ablate.py gives each run one process and runs several at a time (launcher=joblib or slurm); for one "
            "evaluation on many GPUs use experiments/evaluate.py trainer=ddp"
        )


def _is_still_the_row(overrides: Sequence[str]) -> bool:
    keys = [override.lstrip("+~").partition("=")[0].replace("/", ".") for override in overrides]
    return all(any(key == name or key.startswith(f"{name}.") for name in _ROW_MAY_CHANGE) for key in keys)


def _dataset(cfg: DictConfig) -> str:
    return Path(str(cfg.data.root)).expanduser().resolve().name


def _label(settings: Mapping[str, Any]) -> str | None:
    """Why a run's figures mean nothing, if so."""
    # An extractor may wrap another one.
    weights = [
        v for key, v in settings.items() if re.fullmatch(r"(extractor\.)+weights|megapose\.weights", key)
    ]
    return "random weights: the figures mean nothing" if "random" in weights else None


def _root_cause(error: BaseException) -> BaseException:
    """What Hydra's instantiation wraps."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _figures(folder: Path) -> dict[str, Any]:
    """Scores, times and memory of a finished evaluation."""
    scores, timing, memory = (
        json.loads((folder / f"{name}.json").read_text()) for name in ("scores", "timing", "memory")
    )
    figures = {name: scores.get(name) for name in ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD", "targets")}
    figures["time_per_image"] = scores.get("average_time_per_image")
    figures |= {f"seconds_per_instance.{k}": v for k, v in timing["seconds_per_instance"].items()}
    # Of one object, on average; a part that an object lacks takes nothing there.
    mean = pd.DataFrame(memory).fillna(0.0).mean(axis=1)
    return figures | {f"memory.{part}": float(size) for part, size in mean.items()}


def write_reports(folder: str | Path) -> list[RunRecord]:
    """Write results.csv, report.html, the paper's tables, and tables and plots of the settings that were varied.

    Args:
        folder: ``folder`` of ``conf/ablate.yaml``; ``runs`` in it is read, ``tables`` and ``plots`` are written.

    Returns:
        All runs found.
    """
    folder = Path(folder)
    records = collect_runs(folder / "runs") if (folder / "runs").is_dir() else []
    if not records:
        return records
    write_tidy(records, folder / "results.csv")
    write_runs_page(records, folder / "report.html")
    tables: dict[str, str] = {}
    for suffix, format in _FORMATS:
        for number in (1, 2):
            tables[f"table{number}{suffix}"] = paper_table(records, number, format)
        tables[f"memory{suffix}"] = memory_table(records, format)
    finished = [record for record in records if record.status == "finished"]
    for key in varied_settings(finished):
        groups = [] if key in _NOT_VARIED or key.endswith("_target_") else varied_alone(finished, key)
        if not groups:
            continue
        runs = [run for group in groups for run in group]
        apart = _telling_apart(groups, key)
        name = key.replace(".", "_")
        for suffix, format in _FORMATS:
            tables[f"sweep_{name}{suffix}"] = sweep_table(runs, [*apart, key], format=format)
        drawn = [run for run in runs if run.counts and run.settings.get(key) is not None]
        figures = [f for f in SWEEP_FIGURES if any(run.figures.get(f) is not None for run in drawn)]
        if figures:
            several = len({run.dataset for run in runs}) > 1
            series = apart[0] if apart else "dataset" if several else None
            plot_sweep(drawn, key, figures, folder / "plots" / name, series)
    for name, text in tables.items():
        write_text(folder / "tables" / name, text)
    return records


def varied_alone(records: Sequence[RunRecord], key: str) -> list[list[RunRecord]]:
    """Groups of runs that differ in one setting and nothing else, with at least two values of it."""
    groups: dict[str, list[RunRecord]] = defaultdict(list)
    for record in records:
        rest = {k: v for k, v in record.settings.items() if k != key}
        groups[json.dumps([record.dataset, rest], sort_keys=True, default=str)].append(record)
    return [
        group for group in groups.values() if len({json.dumps(run.settings.get(key)) for run in group}) > 1
    ]


class SweepReport(Callback):
    """Writes the reports when a run or a sweep is over, and lists what failed; the app then ends with status 1."""

    def on_run_end(self, config: DictConfig, **kwargs: Any) -> None:
        """After a single run."""
        self._report(config)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """After a sweep."""
        self._report(config)

    def _report(self, config: DictConfig) -> None:
        # Hydra turns errors of a callback into warnings; SystemExit gets through.
        try:
            records = write_reports(config.folder)
        except Exception:
            traceback.print_exc()
            sys.exit(1)
        failed = [record for record in records if record.status == "failed"]
        print(f"{len(records) - len(failed)} runs finished, {len(failed)} failed; see {config.folder}")
        for record in failed:
            say(f"failed: {record.folder}: {record.error}")
        if failed:
            sys.exit(1)


def _telling_apart(groups: Sequence[Sequence[RunRecord]], key: str) -> list[str]:
    """A few settings besides ``key`` that tell groups of runs apart, the extractor first."""
    first = [group[0] for group in groups]
    varied = [k for k in varied_settings(first) if k not in (key, *_NOT_VARIED)]
    varied.sort(key=lambda k: (k != "extractor._target_", k.endswith("_target_"), k))
    chosen: list[str] = []
    kinds = 1
    for candidate in varied:
        values = {
            json.dumps([run.settings.get(k) for k in [*chosen, candidate]], default=str) for run in first
        }
        if len(values) > kinds:
            chosen, kinds = [*chosen, candidate], len(values)
    return chosen

"""What a run of a sweep leaves behind (``run.json``), and all runs as one tidy table."""

import json
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import pandas as pd

from ablation.paper import find_paper_row
from foundpose.utils.files import write_atomically, write_json

RUN_FILE = "run.json"
_FACTS = ("name", "row", "dataset", "status", "error", "label")
_SETTING = "settings."


@dataclass(frozen=True)
class RunRecord:
    """One run: what was set, and what came out.

    Attributes:
        name: of the experiment, or None.
        row: the row of the paper that it is, such as ``table1_row07``, or None.
        dataset: BOP's name, such as ``lmo``.
        status: ``finished`` or ``failed``.
        error: what a failed run failed with.
        label: why the figures mean nothing ("random weights, …"); tables and plots then leave them out. None for
            figures that count.
        settings: values by dotted key (``words.num_words``).
        figures: numbers by name: ``AR``, ``AR_VSD``, ``AR_MSSD``, ``AR_MSPD`` (shares of 1), ``targets``,
            ``time_per_image`` (seconds), ``seconds_per_instance.*``, ``memory.*`` (bytes); None where a figure could
            not be computed.
        folder: of the run; not written.
    """

    name: str | None
    row: str | None
    dataset: str
    status: str
    error: str | None = None
    label: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.status not in ("finished", "failed"):
            raise ValueError(f"status must be finished or failed, got {self.status!r}")
        if self.row is not None:
            find_paper_row(self.row)
        taken = sorted(set(self.figures) & {*_FACTS, "folder"})
        if taken:
            raise ValueError(f"figures must not be named {', '.join(taken)}: a run has facts of that name")

    @property
    def counts(self) -> bool:
        """Whether the run has figures, and they mean something."""
        return self.status == "finished" and self.label is None

    def write(self, folder: str | Path) -> Path:
        """Write ``run.json`` into a run's folder, whole or not at all."""
        path = Path(folder) / RUN_FILE
        content = {name: getattr(self, name) for name in (*_FACTS, "settings", "figures")}
        write_json(path, content)
        return path

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a ``run.json``.

        Raises:
            FileNotFoundError: no such file.
            ValueError: half a file, or another kind of file.
        """
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not whole JSON ({error})") from error
        needed = {"dataset", "status", "settings", "figures"}
        if not isinstance(content, dict) or not needed <= set(content):
            raise ValueError(f"{path} is no record of a run; it should have the entries {sorted(needed)}")
        if not isinstance(content["settings"], dict) or not isinstance(content["figures"], dict):
            raise ValueError(f"{path} should hold settings and figures by name")
        facts: dict[str, Any] = {name: content.get(name) for name in _FACTS}
        try:
            return cls(**facts, settings=content["settings"], figures=content["figures"], folder=path.parent)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def collect_runs(folder: str | Path) -> list[RunRecord]:
    """Records of all runs below a folder, finished and failed, sorted by their folders.

    Runs that were killed have no ``run.json`` and are not in the list. A file that cannot be read is left out with a
    warning.

    Args:
        folder: searched with all folders in it.

    Raises:
        FileNotFoundError: no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder of runs at {folder}")
    records = []
    for path in sorted(folder.rglob(RUN_FILE)):
        try:
            records.append(RunRecord.read(path))
        except ValueError as error:
            warnings.warn(f"a run is left out: {error}", stacklevel=2)
    return records


def tidy(records: Iterable[RunRecord]) -> pd.DataFrame:
    """One row per run: facts, figures and ``settings.*``; None where a run has none.

    Values that are lists or mappings become JSON text.
    """
    rows = []
    for record in records:
        row = {name: getattr(record, name) for name in _FACTS}
        row["folder"] = None if record.folder is None else str(record.folder)
        row |= {f"{_SETTING}{key}": _scalar(value) for key, value in record.settings.items()}
        rows.append(row | {key: _scalar(value) for key, value in record.figures.items()})
    facts = [*_FACTS, "folder"]
    # Figures before settings: there are fewer of them.
    others = sorted(
        {key for row in rows for key in row} - set(facts), key=lambda k: (k.startswith(_SETTING), k)
    )
    columns = {name: pd.Series([row.get(name) for row in rows], dtype=object) for name in [*facts, *others]}
    return pd.DataFrame(columns)


def write_tidy(records: Iterable[RunRecord], path: str | Path) -> Path:
    """Write :func:`tidy` rows as a CSV file, whole or not at all.

    None is an empty field and a truth value is ``true`` or ``false``.

    Args:
        records: the runs.
        path: of the file.

    Raises:
        ValueError: no runs.
    """
    path, table = Path(path), tidy(records)
    if table.empty:
        raise ValueError(f"there are no runs to write to {path}")
    for name, column in table.items():
        words = [str(value).lower() if isinstance(value, bool) else value for value in column]
        table[name] = pd.Series(words, dtype=object)
    write_atomically(path, lambda temporary: table.to_csv(temporary, index=False))
    return path


def varied_settings(records: Sequence[RunRecord]) -> list[str]:
    """Keys of settings that are not the same in all runs (one that only some runs have counts), sorted."""
    keys = {key for record in records for key in record.settings}
    return sorted(
        key for key in keys if len({json.dumps(record.settings.get(key, "(none)")) for record in records}) > 1
    )


def _scalar(value: Any) -> Any:
    return value if value is None or isinstance(value, (str, int, float, bool)) else json.dumps(value)

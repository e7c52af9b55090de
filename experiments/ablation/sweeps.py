"""Tables of sweeps."""

from collections.abc import Sequence
from typing import Any

import pandas as pd

from ablation.records import RunRecord, varied_settings
from ablation.text_tables import MISSING, Cell, Format, TextTable
from ablation.units import mean, title_of, unit_of, why_no_figures

SWEEP_FIGURES = ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD", "time_per_image", "memory.total")
"""What :func:`sweep_table` shows of runs, as far as they have it."""


def sweep_table(
    records: Sequence[RunRecord],
    keys: Sequence[str],
    figures: Sequence[str] | None = None,
    format: Format = "markdown",
) -> str:
    """A table with a row for each combination of values of some settings.

    Several runs with the same values are averaged; a note says what else they differ in. Runs on different datasets
    are kept apart.

    Args:
        records: the runs of a sweep.
        keys: settings by dotted key.
        figures: names of figures; by default those of ``SWEEP_FIGURES`` that some run has.
        format: ``markdown`` or ``latex``.

    Raises:
        ValueError: no runs, no keys, or a key that no run has.
    """
    records, keys = list(records), list(keys)
    if not records or not keys:
        raise ValueError(f"a table needs runs and keys of settings, got {len(records)} runs and keys {keys}")
    for key in keys:
        if all(key not in record.settings for record in records):
            raise ValueError(
                f"no run has the setting {key!r}; the settings that vary: {varied_settings(records)}"
            )
    if figures is None:
        counted = [record.figures for record in records if record.counts]
        figures = [name for name in SWEEP_FIGURES if any(each.get(name) is not None for each in counted)]
    heads = pd.DataFrame({key: [_show(record.settings.get(key)) for record in records] for key in keys})
    if len({record.dataset for record in records}) > 1:
        heads.insert(0, "dataset", [record.dataset for record in records])
    titles = list(heads.columns) + [title_of(name) for name in figures]
    numeric = [bool(heads[head].map(_is_number).all()) for head in heads.columns]
    text = TextTable(titles, numeric + [True] * len(figures), key="sweep")
    groups = {values: part.index for values, part in heads.groupby(list(heads.columns), sort=False)}
    for values in sorted(groups, key=lambda values: [_sort_key(value) for value in values]):
        runs = [records[i] for i in groups[values]]
        text.rows.append([Cell(value) for value in values] + _cells(runs, figures, text))
    return text.render(format)


def _cells(runs: Sequence[RunRecord], figures: Sequence[str], text: TextTable) -> list[Cell]:
    counting = [run for run in runs if run.counts]
    if not counting:
        outcome, why = why_no_figures(runs)
        return [Cell(outcome, text.note(why)) for _ in figures]
    note = None
    if len(counting) > 1:
        varied = ", ".join(varied_settings(counting)) or "nothing that is recorded"
        note = text.note(f"Mean of {len(counting)} runs, which differ in {varied}.")
    values = {name: mean([run.figures.get(name) for run in counting]) for name in figures}
    return [
        Cell(MISSING) if value is None else Cell(unit_of(name).show(value), note)
        for name, value in values.items()
    ]


def _show(value: Any) -> str:
    return MISSING if value is None else str(value)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text == MISSING
    return True


def _sort_key(text: str) -> tuple[int, float, str]:
    """Missing values first, then numbers by size, then text."""
    if text == MISSING:
        return (0, 0.0, "")
    return (1, float(text), "") if _is_number(text) else (2, 0.0, text)

"""Figures of sweeps."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, NullLocator

from ablation.records import RunRecord, varied_settings
from ablation.units import title_of, unit_of
from foundpose.utils.files import write_atomically

_FORMATS = (".png", ".pdf")
_MARKERS = "osD^vP*X"
_MOST_TICKS = 12


def plot_sweep(
    records: Sequence[RunRecord],
    key: str,
    figures: Sequence[str],
    path: str | Path,
    series: str | None = None,
) -> list[Path]:
    """Plot figures of runs against a setting: a panel for each figure, a line for each series.

    Runs that failed, and those with a label, are left out. Several runs at one value are drawn as points with the
    line through their mean. Numbers that grow by factors get a logarithmic axis; values that are no numbers stand
    side by side.

    Args:
        records: the runs.
        key: setting on the x axis, by dotted key (``words.num_words``).
        figures: names of figures (``AR``, ``time_per_image``, ``memory.total``, …).
        path: a ``.png`` or ``.pdf`` file; with another ending or none, both are written beside each other.
        series: a setting that has a line of its own for each value, or ``dataset``; None for one line.

    Returns:
        The files, written whole or not at all.

    Raises:
        ValueError: no run that counts has the setting and one of the figures.
    """
    path = Path(path)
    runs = [record for record in records if record.counts and record.settings.get(key) is not None]
    lacking = [name for name in figures if all(run.figures.get(name) is None for run in runs)]
    if not figures or lacking:
        raise ValueError(
            f"no run that counts has both the setting {key!r} and {', '.join(lacking) or 'a figure'}; the settings "
            f"that vary: {varied_settings(list(records))}"
        )
    table = pd.DataFrame(
        {
            "value": pd.Series([_value(run, key) for run in runs], dtype=object),
            "series": pd.Series([_series_of(run, series) for run in runs], dtype=object),
            **{name: pd.Series([run.figures.get(name) for run in runs], dtype=float) for name in figures},
        }
    )
    values, names = _ordered(table["value"]), _ordered(table["series"])
    picture = Figure(figsize=(0.6 + 3.6 * len(figures), 3.1), layout=ConstrainedLayoutEngine(wspace=0.06))
    panels = picture.subplots(1, len(figures), squeeze=False)[0]
    for panel, name in zip(panels, figures, strict=True):
        _set_axis(panel, key, values)
        for i, each in enumerate(names):
            line = table[[each is value or each == value for value in table["series"]]]
            scaled = (line.set_index("value")[name] * unit_of(name).factor).dropna()
            _draw_line(panel, scaled, values, "" if each is None else str(each), i)
        panel.set_ylabel(title_of(name))
        decorate(panel)
        if not name.startswith("AR"):
            # Time and memory are amounts: without zero, small changes look large.
            panel.set_ylim(0, 1.08 * panel.dataLim.ymax or 1.0)
    if len(names) > 1:
        picture.legend(
            *panels[0].get_legend_handles_labels(),
            title=series,
            loc="outside upper center",
            ncols=min(len(names), 1 + 2 * len(figures)),
            frameon=False,
        )
    return save_figure(picture, path)


def decorate(panel: Axes) -> None:
    """A light grid behind the data, and no box around it."""
    panel.grid(visible=True, color="0.9", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write a ``.png`` or ``.pdf`` file, or both where the path ends in neither, each whole or not at all."""
    files = [path] if path.suffix in _FORMATS else [path.with_name(path.name + suffix) for suffix in _FORMATS]
    for file in files:
        # Without a date, the same runs give the same file.
        metadata = {"CreationDate": None} if file.suffix == ".pdf" else {}
        write_atomically(file, partial(figure.savefig, dpi=150, metadata=metadata))
    return files


def _draw_line(panel: Axes, points: "pd.Series[float]", values: list[Any], label: str, index: int) -> None:
    """One series, by the values of the setting: points of all runs, and a line through the means."""
    numeric = _is_numeric(values)
    color, marker = f"C{index}", _MARKERS[index % len(_MARKERS)]
    by_value = points.groupby(level=0, sort=False)
    means = by_value.mean().reindex([value for value in values if value in by_value.groups])
    places = {value: value if numeric else values.index(value) for value in means.index}
    line = "-" if numeric else ":"
    xs = list(places.values())
    panel.plot(xs, means, line, color=color, marker=marker, markersize=5, label=label)
    spread = points[(by_value.transform("size") > 1).to_numpy()]
    if len(spread):
        at = [places[value] for value in spread.index]
        panel.plot(at, spread, linestyle="", marker=".", color=color, alpha=0.4)


def _set_axis(panel: Axes, key: str, values: list[Any]) -> None:
    panel.set_xlabel(key)
    if not _is_numeric(values):
        panel.set_xticks(range(len(values)), [str(value) for value in values])
        panel.set_xlim(-0.5, len(values) - 0.5)
        return
    if _grows_by_factors(values):
        panel.set_xscale("log", base=2)
    if len(values) <= _MOST_TICKS:
        panel.set_xticks(values)
        panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _grows_by_factors(values: list[Any]) -> bool:
    """Whether positive numbers are more evenly spaced on a logarithmic axis than on a linear one."""
    if len(values) < 3 or min(values) <= 0:
        return False
    steps = np.diff(np.asarray(values, dtype=float))
    ratios = np.diff(np.log(np.asarray(values, dtype=float)))
    return bool(ratios.std() / ratios.mean() < steps.std() / steps.mean())


def _is_numeric(values: Sequence[Any]) -> bool:
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def _ordered(values: Iterable[Any]) -> list[Any]:
    """Distinct values: numbers by size, others as text, None first."""
    distinct = list(dict.fromkeys(values))
    if _is_numeric(distinct):
        return sorted(distinct)
    return sorted(distinct, key=lambda value: (value is not None, str(value)))


def _value(run: RunRecord, key: str) -> Any:
    """A setting; lists as text."""
    value = run.settings.get(key)
    return value if value is None or isinstance(value, (bool, int, float)) else str(value)


def _series_of(run: RunRecord, series: str | None) -> Any:
    if series is None:
        return None
    return run.dataset if series == "dataset" else _value(run, series)

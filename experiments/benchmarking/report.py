"""What a benchmark leaves behind: JSON, tables and plots."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from ablation.text_tables import MISSING, text_table
from benchmarking.checks import Check, shares
from benchmarking.curves import Curve
from benchmarking.inference import HOOKED, YARDSTICK
from benchmarking.plots import plot_curve, plot_shares
from benchmarking.references import Comparison
from benchmarking.tasks import Row
from foundpose.utils.files import write_json, write_text

SCHEMA_VERSION = 1
_BUSY = 0.5  # load average by core
_TITLES = {
    "stages": "Stages of inference, forward",
    "pipeline": "Pipeline",
    "backward": "Forward and backward",
    "onboarding": "Onboarding",
}


@dataclass
class BenchmarkResult:
    """All that was measured.

    Attributes:
        settings: the configuration.
        hardware: what it ran on.
        versions: with what.
        rows: measured tasks.
        curves: scaling curves.
        comparisons: with references.
        checks: ratios that the library aims at.
        seconds: the whole benchmark took.
    """

    settings: dict[str, Any]
    hardware: dict[str, Any]
    versions: dict[str, str | None]
    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    seconds: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """All of it as plain values; rows know their shares of the yardstick and of the extractor."""
        return {
            "schema_version": SCHEMA_VERSION,
            "settings": self.settings,
            "hardware": self.hardware,
            "versions": self.versions,
            "seconds": self.seconds,
            "rows": [asdict(row) | self.shares(row) for row in self.rows],
            "curves": [asdict(curve) for curve in self.curves],
            "references": [asdict(comparison) for comparison in self.comparisons],
            "checks": [asdict(check) | {"passed": check.passed} for check in self.checks],
        }

    def shares(self, row: Row) -> dict[str, float | None]:
        """A row's shares of the yardstick and of the extractor."""
        return {
            "share_of_yardstick": self.share(row, YARDSTICK),
            "share_of_extractor": self.share(row, HOOKED),
        }

    def share(self, row: Row, name: str) -> float | None:
        """A row's time per crop as a share of another's in the same batch size; None where that means nothing."""
        whole = shares(self.rows, name).get(row.batch_size or 0)
        return None if whole is None or row.unit != "crop" else row.per_unit / whole


def write_report(result: BenchmarkResult, folder: Path) -> str:
    """Write ``benchmark.json``, ``benchmark.md`` and ``plots/`` into a folder, each file whole or not at all.

    Returns:
        The text of ``benchmark.md``.
    """
    write_json(folder / "benchmark.json", result.as_json())
    text = render(result)
    write_text(folder / "benchmark.md", text)
    for curve in result.curves:
        plot_curve(curve, folder / "plots")
    for batch_size in shares(result.rows, YARDSTICK):
        rows = [row for row in result.rows if row.group == "stages" and row.batch_size == batch_size]
        rows = [row for row in rows if row.name != YARDSTICK]
        of = [result.share(row, YARDSTICK) or 0.0 for row in rows]
        title = f"stages at batch size {batch_size}"
        plot_shares(rows, of, title, folder / "plots" / f"stages-batch{batch_size}")
    return text


def render(result: BenchmarkResult) -> str:
    """The tables as Markdown."""
    hardware = result.hardware
    where = f"{hardware['cpu']}, {hardware['cores_available']} cores, {hardware['threads']} threads"
    if hardware["gpu"]:
        where += f", {hardware['gpu']}"
    versions = result.versions
    parts = [
        "# Benchmark\n",
        f"{where}; torch {versions['torch']}, foundpose {versions['foundpose']}"
        f" ({(versions['commit'] or 'no commit')[:12]}); {result.seconds:.0f} s.\n",
    ]
    load, cores = hardware["load_average"], hardware["cores_available"]
    if load is not None and load > _BUSY * cores:
        parts.append(
            f"**The machine was busy when this began (load average {load:.1f} on {cores} cores): "
            "do not trust these times.**\n"
        )
    for group, title in _TITLES.items():
        rows = [row for row in result.rows if row.group == group]
        if rows:
            parts.append(_rows_table(result, rows, title))
    if result.comparisons:
        parts.append(_comparison_table(result.comparisons))
    if result.checks:
        parts.append(check_table(result.checks))
    return "\n".join(parts)


def _rows_table(result: BenchmarkResult, rows: Sequence[Row], title: str) -> str:
    of_crops = any(row.unit == "crop" for row in rows)
    cells = []
    for row in rows:
        line = {
            title: row.name,
            "batch": MISSING if row.batch_size is None else str(row.batch_size),
            "median": duration(row.median),
            "quartiles": f"{duration(row.lower)} to {duration(row.upper)}",
            "n": str(row.calls),
        }
        if of_crops:
            line["per crop"] = duration(row.per_unit)
            line["% of yardstick"] = _percent(result.share(row, YARDSTICK))
            line["% of extractor"] = _percent(result.share(row, HOOKED))
        else:
            line["per unit"] = f"{duration(row.per_unit)}/{row.unit}"
            whole = row.projected
            line["whole object"] = MISSING if whole is None else f"{duration(whole)} (projected)"
        cells.append(line | {"memory": _mebibytes(row.memory_rise), "note": _note(row)})
    reasons = sorted({row.memory_reason for row in rows if row.memory_reason})
    return _markdown(cells, "note", [f"memory: {reason}" for reason in reasons])


def _comparison_table(comparisons: Sequence[Comparison]) -> str:
    cells = []
    for each in comparisons:
        agreement = ", ".join(f"{name} {value:.4g}" for name, value in each.agreement.items())
        faster = MISSING if each.times_faster is None else f"{each.times_faster:.2g}×"
        cells.append(
            {
                "Reference": each.name,
                "reference": duration(each.reference),
                "ours": duration(each.ours),
                "ours is faster": faster,
                "agreement": agreement or each.note,
            }
        )
    return _markdown(cells, "agreement")


def check_table(checks: Sequence[Check]) -> str:
    """Figures beside their limits, as Markdown."""
    cells = [
        {
            "Check": check.name,
            "measured": f"{check.value:.4g} {check.unit}",
            "aim": f"{'≥' if check.at_least else '≤'} {check.limit:g} {check.unit}",
            "met": "yes" if check.passed else "no",
        }
        for check in checks
    ]
    return _markdown(cells)


def _markdown(cells: Sequence[Mapping[str, str]], text: str = "", remarks: Sequence[str] = ()) -> str:
    """A table of strings; its first column and the one named ``text`` are flush left."""
    frame = pd.DataFrame(cells)
    table = text_table(list(frame), frame.to_numpy().tolist())
    table.numeric = [i > 0 and name != text for i, name in enumerate(frame)]
    table.remarks += remarks
    return table.render("markdown")


def duration(seconds: float | None) -> str:
    """Seconds with three digits and a fitting unit."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    units = ((1.0, "s"), (1e3, "ms"), (1e6, "µs"))
    factor, unit = next((each for each in units if seconds * each[0] >= 1.0), units[-1])
    value = seconds * factor
    return f"{value:.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}"


def _percent(share: float | None) -> str:
    if share is None:
        return MISSING
    return f"{100 * share:.0f} %" if share >= 0.0995 else f"{100 * share:.2g} %"


def _mebibytes(size: int | None) -> str:
    return MISSING if size is None else f"{size / 2**20:.0f} MiB"


def _note(row: Row) -> str:
    facts = [
        f"{name.replace('_', ' ')} {value:.3g}"
        if isinstance(value, float)
        else f"{name.replace('_', ' ')} {value}"
        for name, value in row.facts.items()
    ]
    if row.host_syncs is not None:
        facts.append(f"{row.host_syncs} host syncs")
    return "; ".join(([row.note] if row.note else []) + facts)

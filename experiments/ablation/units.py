"""How figures of runs are shown."""

from collections.abc import Sequence
from typing import NamedTuple

from ablation.records import RunRecord


class Unit(NamedTuple):
    """Unit in which a figure is shown.

    Attributes:
        name: such as ``MiB``; empty for plain numbers.
        factor: from the recorded unit to this one.
        decimals: to show, or None for three significant digits.
    """

    name: str
    factor: float
    decimals: int | None

    def show(self, value: float) -> str:
        """A recorded value as text in this unit."""
        scaled = value * self.factor
        return significant(scaled) if self.decimals is None else f"{scaled:.{self.decimals}f}"


def unit_of(figure: str) -> Unit:
    """Unit of a figure: recalls in percent, memory in MiB, times in seconds, others as they are."""
    if figure.startswith("AR"):
        return Unit("%", 100.0, 1)
    if figure.startswith("memory."):
        return Unit("MiB", 2.0**-20, 1)
    return Unit("s" if "time" in figure or "seconds" in figure else "", 1.0, None)


def title_of(figure: str) -> str:
    """Name of a figure with its unit."""
    unit = unit_of(figure).name
    return f"{figure} ({unit})" if unit else figure


def mean(values: Sequence[float | None]) -> float | None:
    """Mean of values that are all there; None if one is missing or there are none."""
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present and len(present) == len(values) else None


def significant(value: float) -> str:
    """Whole numbers as they are, others with three significant digits, and all digits before the point."""
    if isinstance(value, int) or abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:#.3g}".rstrip(".")


def why_no_figures(runs: Sequence[RunRecord]) -> tuple[str, str]:
    """What stands in place of the figures of runs that do not count, and a note on it."""
    labels = [run.label for run in runs if run.status == "finished" and run.label is not None]
    if labels:
        return "runs", f"It runs; no figures are given: {labels[0].rstrip('.')}."
    # The last line of a traceback tells what was wrong.
    lines = (runs[0].error or "").strip().splitlines()
    return "failed", f"Failed: {lines[-1] if lines else 'no reason is recorded'}"

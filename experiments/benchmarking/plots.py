"""Figures of a benchmark."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from ablation.plots import decorate, save_figure
from benchmarking.curves import AXES, Curve
from benchmarking.tasks import Row

_MARKERS = "osD^vP*X"
_MILLISECONDS = 1e3


def plot_curve(curve: Curve, folder: Path) -> list[Path]:
    """Milliseconds per crop against the size that was varied, with quartiles as bands.

    The axis of times is logarithmic where they span more than a factor of ten.

    Returns:
        A PNG and a PDF file, each written whole or not at all.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    panel = figure.subplots()
    for i, (label, points) in enumerate(curve.series.items()):
        xs = [point.x for point in points]
        middle, lower, upper = (
            [_MILLISECONDS * getattr(point, name) for point in points]
            for name in ("median", "lower", "upper")
        )
        marker = _MARKERS[i % len(_MARKERS)]
        panel.plot(xs, middle, color=f"C{i}", marker=marker, markersize=4, label=label)
        panel.fill_between(xs, lower, upper, color=f"C{i}", alpha=0.15, linewidth=0)
    panel.set_xscale("log", base=2)
    ticks = sorted({point.x for points in curve.series.values() for point in points})
    panel.set_xticks(ticks)
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    times = [point.median for points in curve.series.values() for point in points]
    if max(times) > 10 * min(times):
        panel.set_yscale("log")
        panel.yaxis.set_minor_formatter(NullFormatter())
    else:
        panel.set_ylim(bottom=0)
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.set_xlabel(AXES[curve.name])
    panel.set_ylabel("ms per crop")
    if curve.batch_size is not None:
        panel.set_title(f"batch size {curve.batch_size}", fontsize="medium", loc="left")
    decorate(panel)
    columns = 3 if len(curve.series) > 2 else 1
    figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize="small")
    return save_figure(figure, folder / curve.name)


def plot_shares(rows: Sequence[Row], shares: Sequence[float], title: str, path: Path) -> list[Path]:
    """Bars of stages' shares of the yardstick, in percent.

    Args:
        rows: one for each bar, from top to bottom.
        shares: of the yardstick's time.
        title: over the plot.
        path: without an ending.
    """
    figure = Figure(figsize=(6.4, 0.8 + 0.28 * len(rows)), layout="constrained")
    panel = figure.subplots()
    percent = [100 * share for share in shares]
    bars = panel.barh([row.name for row in rows], percent, color="C0", height=0.7)
    panel.bar_label(bars, [f"{value:.2g} %" for value in percent], padding=3, fontsize="small")
    panel.invert_yaxis()
    panel.set_xlim(0, 1.15 * max(percent, default=1.0))
    panel.set_xlabel("share of one forward pass of the yardstick, per crop (%)")
    panel.set_title(title, fontsize="medium", loc="left")
    decorate(panel)
    panel.grid(visible=False, axis="y")
    return save_figure(figure, path)

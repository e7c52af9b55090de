"""Diagrams of probabilities against what turned out right."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from foundpose.utils.files import write_atomically


def save_reliability_diagram(
    path: str | Path, probability: Sequence[float], right: Sequence[float], count: Sequence[int]
) -> None:
    """Draw the share of right poses against their mean probability, bin by bin, as a PNG file.

    Args:
        path: of the file, which is written whole or not at all.
        probability: mean probability of the poses of a bin.
        right: share of them that are right.
        count: how many there are; bins without any are left out. The area of a mark is in proportion to it.
    """
    bins = [(p, y, n) for p, y, n in zip(probability, right, count, strict=True) if n]
    figure = Figure(figsize=(4.2, 4.2), layout="constrained")
    panel = figure.subplots()
    panel.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    x, y, n = zip(*bins, strict=True) if bins else ((), (), ())
    panel.plot(x, y, color="C0", linewidth=1)
    panel.scatter(x, y, s=[600 * k / sum(n) for k in n], color="C0", alpha=0.6)
    for p, share, k in bins:
        panel.annotate(str(k), (p, share), textcoords="offset points", xytext=(6, -10), fontsize=8)
    panel.set(xlim=(0, 1), ylim=(0, 1), xlabel="probability", ylabel="share of right poses")
    panel.set_aspect("equal")
    write_atomically(Path(path), lambda temporary: figure.savefig(temporary, format="png", dpi=120))

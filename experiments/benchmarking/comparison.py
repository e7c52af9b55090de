"""A benchmark beside an earlier one: which stages became slower, in forward passes of the same run's yardstick."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarking.inference import YARDSTICK

MOST_SLOWER = 1.25
"""How much longer a stage may take than before."""
# What must be alike, or rows of the same name do not mean the same.
_ALIKE = ("sizes", "num_hypotheses", "ransac_iterations", "lm_iterations", "dtype", "precision")
_Key = tuple[str, str, int | None]


@dataclass(frozen=True)
class Change:
    """The time of a stage, in forward passes of the yardstick, in an earlier run and now.

    Attributes:
        group: section of the table.
        name: of the row.
        batch_size: of the row.
        before: median of the earlier run.
        now: median of this one.
        apart: the quartiles of both do not overlap.
    """

    group: str
    name: str
    batch_size: int | None
    before: float
    now: float
    apart: bool

    @property
    def slower(self) -> bool:
        """More than noise, and more than is let pass."""
        return self.apart and self.now > MOST_SLOWER * self.before


def read_benchmark(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """An earlier ``benchmark.json`` that can be compared with a run.

    Args:
        path: the file.
        settings: of the run.

    Raises:
        ValueError: the file is none, or of a workload of other sizes.
    """
    try:
        content = json.loads(path.read_text())
        earlier = content["settings"]
        _relative_times(content)
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"compare must be the benchmark.json of an earlier run, got {path} ({error})"
        ) from None
    for name in _ALIKE:
        if earlier.get(name) != settings[name]:
            raise ValueError(
                f"{path} cannot be compared with: its {name} is {earlier.get(name)}, and {settings[name]} here"
            )
    return dict(content)


def compare(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Change]:
    """All rows that two benchmarks (as in ``benchmark.json``) have in common, those that became slowest first."""
    earlier = dict(_relative_times(before))
    changes = [
        Change(*key, earlier[key][1], median, apart=lower > earlier[key][2] or upper < earlier[key][0])
        for key, (lower, median, upper) in _relative_times(now)
        if key in earlier
    ]
    return sorted(changes, key=lambda change: change.before / change.now)


def describe(changes: list[Change], before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Lines that say what became slower."""
    slower = [change for change in changes if change.slower]
    lines = [
        f"SLOWER: {change.group}, {change.name}, batch {change.batch_size}: {change.before:.2%} → {change.now:.2%} "
        f"of a forward pass (× {change.now / change.before:.2f})"
        for change in slower
    ]
    lines.append(
        f"{len(slower)} of {len(changes)} stages are more than {MOST_SLOWER - 1:.0%} slower than in "
        f"{(before['versions'].get('commit') or 'an unknown commit')[:12]}"
    )
    for name in ("cpu", "gpu", "threads"):
        if before["hardware"].get(name) != now["hardware"].get(name):
            was, is_now = before["hardware"].get(name), now["hardware"].get(name)
            lines.append(f"compare with care: {name} was {was}, and is {is_now}")
    return "\n".join(lines)


def _relative_times(content: Mapping[str, Any]) -> Iterator[tuple[_Key, tuple[float, float, float]]]:
    """First quartile, median and third quartile of each row by unit, in forward passes of one crop."""
    rows = content["rows"]
    passes = {row["batch_size"]: row["per_unit"] for row in rows if row["name"] == YARDSTICK}
    for row in rows:
        if row["name"] == YARDSTICK or not passes:
            continue
        whole = passes.get(row["batch_size"] if row["unit"] == "crop" else min(passes))
        if whole is not None:
            key = row["group"], row["name"], row["batch_size"]
            lower, median, upper = (
                row[name] / (row["units"] * whole) for name in ("lower", "median", "upper")
            )
            yield key, (lower, median, upper)

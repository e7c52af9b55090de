"""Recalls of an evaluation, as JSON and as a table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

AVERAGED = ("vsd", "mssd", "mspd")
"""Errors whose average recalls make up the benchmark's AR."""


class Recall(NamedTuple):
    """How many instances were found.

    Attributes:
        found: (T,) int64 at each threshold; (taus, T) for VSD.
        targets: number of instances to be found.
    """

    found: Tensor
    targets: int

    @property
    def recalls(self) -> Tensor | None:
        """Shares of the targets, float64, shaped as ``found``; None without targets."""
        return self.found.to(torch.float64) / self.targets if self.targets else None

    @property
    def average(self) -> float | None:
        """Mean over all thresholds (average recall); None without targets."""
        return float(self.recalls.mean()) if self.recalls is not None else None

    def to_json(self, averaged: bool) -> dict[str, Any]:
        """Plain numbers; with the average recall ``AR`` on request."""
        recalls = None if self.recalls is None else self.recalls.tolist()
        numbers = {"targets": self.targets, "found": self.found.tolist(), "recalls": recalls}
        return numbers | ({"AR": self.average} if averaged else {})


@dataclass(frozen=True)
class FunctionScores:
    """Recalls under one error function.

    Attributes:
        thresholds: below which an error counts as correct.
        unit: of the thresholds.
        total: of all objects together.
        objects: by object id.
        taus: misalignment tolerances of VSD, shares of the diameter; None for the others.
    """

    thresholds: list[float]
    unit: str
    total: Recall
    objects: dict[int, Recall]
    taus: list[float] | None = None

    def to_json(self, averaged: bool) -> dict[str, Any]:
        """Plain numbers; with average recalls on request."""
        taus = {"taus": self.taus} if self.taus is not None else {}
        head = {"computed": True, **taus, "thresholds": self.thresholds, "thresholds_are": self.unit}
        objects = {str(obj_id): recall.to_json(averaged) for obj_id, recall in self.objects.items()}
        return head | self.total.to_json(averaged) | {"objects": objects}


@dataclass(frozen=True)
class Scores:
    """Localisation recall of a set of estimates on the targets of a dataset.

    Attributes:
        dataset: facts about dataset and estimates by name, as they go into the JSON.
        targets: instances to be found, by object id.
        functions: recalls by error function.
        not_computed: error functions that could not be evaluated, or were not asked for, with the reason.
    """

    dataset: dict[str, Any]
    targets: dict[int, int]
    functions: dict[str, FunctionScores]
    not_computed: dict[str, str]

    def average_recall(self, function: str, obj_id: int | None = None) -> float | None:
        """Mean recall under one error, of all objects together or of one; None where it was not computed."""
        if function not in self.functions:
            return None
        scores = self.functions[function]
        return (scores.total if obj_id is None else scores.objects[obj_id]).average

    def overall(self, obj_id: int | None = None) -> float | None:
        """The benchmark's AR: the mean of AR_VSD, AR_MSSD and AR_MSPD; None unless there are all three."""
        averages = [self.average_recall(function, obj_id) for function in AVERAGED]
        present = [average for average in averages if average is not None]
        return sum(present) / len(AVERAGED) if len(present) == len(AVERAGED) else None

    def to_json(self) -> dict[str, Any]:
        """Everything as plain numbers, for ``scores.json``; what was not computed says why."""
        content = dict(self.dataset)
        content["AR"] = self.overall()
        missing = [
            f"AR_{name.upper()} ({self.not_computed[name]})" for name in AVERAGED if name in self.not_computed
        ]
        if missing:
            content["AR_missing"] = f"AR needs {' and '.join(missing)}"
        content |= {f"AR_{function.upper()}": self.average_recall(function) for function in AVERAGED}
        for name, scores in self.functions.items():
            content[name] = scores.to_json(averaged=name in AVERAGED)
        for name, reason in self.not_computed.items():
            content[name] = {"computed": False, "reason": reason}
        content["objects"] = {
            str(obj_id): {"targets": count, "AR": self.overall(obj_id)}
            | {f"AR_{function.upper()}": self.average_recall(function, obj_id) for function in AVERAGED}
            for obj_id, count in self.targets.items()
        }
        return content

    def table(self) -> str:
        """A short table: a row for each object and one for all together."""
        columns = {"AR_MSSD": "mssd", "AR_MSPD": "mspd", "AR_VSD": "vsd"}
        rows: list[Mapping[str, str]] = []
        total = sum(self.targets.values())
        for obj_id, count in [*self.targets.items(), (None, total)]:
            row = {"object": "all" if obj_id is None else str(obj_id), "targets": str(count)}
            row |= {title: percent(self.average_recall(name, obj_id)) for title, name in columns.items()}
            row["AR"] = percent(self.overall(obj_id))
            if "add_s" in self.functions:
                scores = self.functions["add_s"]
                recalls = (scores.total if obj_id is None else scores.objects[obj_id]).recalls
                # The usual figure: errors below a tenth of the diameter.
                row["ADD(-S) 0.1d"] = percent(None if recalls is None else float(recalls[-1]))
            rows.append(row)
        return text_table(rows)


def text_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows as aligned text under their keys, the last below a line."""
    widths = {title: max(len(title), *(len(row[title]) for row in rows)) for title in rows[0]}
    lines = ["  ".join(title.rjust(width) for title, width in widths.items())]
    lines += ["  ".join(row[title].rjust(width) for title, width in widths.items()) for row in rows]
    lines.insert(-1, "-" * len(lines[0]))
    return "\n".join(lines)


def percent(share: float | None) -> str:
    """A share in percent with one decimal; a dash for None."""
    return "–" if share is None else f"{100 * share:.1f}"

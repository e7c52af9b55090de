"""The paper's numbers, read from ``paper.yaml``."""

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import yaml


@dataclass(frozen=True)
class PaperRow:
    """A row of one of the paper's tables, as printed.

    Attributes:
        table: number of the table.
        row: number of the row.
        method: first column.
        refinement: refinement stage, None where there is none (or the table has no such column).
        no_training: whether the method needs no training for the task; None where the table does not say.
        ours: whether the row is a variant of FoundPose, which this library runs.
        peer: whether it is another method that this library runs, made of the same parts.
        average_recall: AR in percent by dataset; None where none is printed.
        average: mean AR, percent.
        time: seconds per image.
        same_as: the experiment of another table that is this row's too.
    """

    table: int
    row: int
    method: str
    refinement: str | None
    no_training: bool | None
    ours: bool
    peer: bool
    average_recall: dict[str, float | None]
    average: float | None
    time: float | None
    same_as: str | None

    @property
    def experiment(self) -> str:
        """Name of the experiment that runs this row, such as ``table1_row07``."""
        return f"table{self.table}_row{self.row:02d}"


@dataclass(frozen=True)
class PaperSection:
    """Rows of a table under one heading."""

    title: str
    rows: tuple[PaperRow, ...]


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables.

    Attributes:
        number: 1 or 2.
        title: what it shows.
        source: where it stands.
        sections: its rows under their headings.
    """

    number: int
    title: str
    source: str
    sections: tuple[PaperSection, ...]

    @property
    def rows(self) -> tuple[PaperRow, ...]:
        """All rows, in order."""
        return tuple(row for section in self.sections for row in section.rows)


@dataclass(frozen=True)
class PaperDataset:
    """A column of the paper's tables.

    Attributes:
        name: BOP's name.
        title: as printed.
        targets: instances to be found in BOP's test targets of 2019.
    """

    name: str
    title: str
    targets: int


@cache
def paper_numbers() -> dict[str, Any]:
    """Everything in ``paper.yaml``, as it stands there. Not to be changed."""
    return yaml.safe_load(files("ablation").joinpath("paper.yaml").read_text(encoding="utf-8"))


@cache
def paper_datasets() -> tuple[PaperDataset, ...]:
    """The seven core datasets, in the order of the columns."""
    columns = paper_numbers()["datasets"]
    triples = zip(columns["names"], columns["titles"], columns["targets"], strict=True)
    return tuple(PaperDataset(name, title, targets) for name, title, targets in triples)


@cache
def read_paper_table(number: int) -> PaperTable:
    """One of the paper's tables.

    Args:
        number: 1 (BOP datasets) or 2 (ablations).

    Raises:
        ValueError: no such table.
    """
    tables = paper_numbers()["tables"]
    if number not in tables:
        raise ValueError(f"table must be one of {sorted(tables)}, got {number!r}")
    table = tables[number]
    sections = tuple(
        PaperSection(section["title"], tuple(_row(number, row) for row in section["rows"]))
        for section in table["sections"]
    )
    return PaperTable(number, table["title"], table["source"], sections)


def find_paper_row(experiment: str) -> PaperRow:
    """The row that an experiment runs.

    Args:
        experiment: such as ``table1_row07``.

    Raises:
        ValueError: not the name of a row of the paper.
    """
    match = re.fullmatch(r"table(\d+)_row(\d\d)", experiment)
    if match and int(match[1]) in paper_numbers()["tables"]:
        for row in read_paper_table(int(match[1])).rows:
            if row.row == int(match[2]):
                return row
    raise ValueError(
        f"row must be named such as table1_row07, after a row of the paper's tables; got {experiment!r}"
    )


def _row(table: int, facts: dict[str, Any]) -> PaperRow:
    names = [dataset.name for dataset in paper_datasets()]
    return PaperRow(
        table=table,
        row=facts["row"],
        method=facts["method"],
        refinement=facts.get("refinement"),
        no_training=facts.get("no_training"),
        ours=facts.get("ours", False),
        peer=facts.get("peer", False),
        average_recall=dict(zip(names, facts["AR"], strict=True)),
        average=facts["average"],
        time=facts["time"],
        same_as=facts.get("same_as"),
    )

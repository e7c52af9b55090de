"""The paper's tables with our figures beside them."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from ablation.paper import (
    PaperDataset,
    PaperRow,
    find_paper_row,
    paper_datasets,
    paper_numbers,
    read_paper_table,
)
from ablation.records import RunRecord, varied_settings
from ablation.text_tables import MISSING, Cell, Format, Heading, Style, TextTable
from ablation.units import mean, significant, why_no_figures

_PLAIN: Style = "plain"


class _Ours(NamedTuple):
    """What our runs of one row on one dataset say; at most one of the first two is there."""

    percent: float | None = None
    text: str = MISSING
    note: str | None = None
    time: float | None = None


def paper_table(records: Sequence[RunRecord], table: int, format: Format = "markdown") -> str:
    """One of the paper's tables in its own form, with our figures and the differences below the paper's.

    Every row of the paper keeps its place. Rows that this library runs have a second line with our figures, and a
    third with ours minus the paper's where there are any. What there is no figure for is marked –. An AR of ours
    stands in the table only if it is one: all three errors, on all test targets of the dataset. Anything less is in
    a note, as are failures. Runs with a label say only that they ran.

    Args:
        records: of any runs; those of this table's rows are taken (``RunRecord.row``).
        table: 1 (BOP datasets) or 2 (ablations).
        format: ``markdown`` or ``latex``.

    Returns:
        The table's text.

    Raises:
        ValueError: no such table or format.
    """
    paper = read_paper_table(table)
    source = paper_numbers()["source"]
    datasets = paper_datasets()
    with_refinement = table == 1
    facts = ["#", "Method", *(["Pose refinement", "No train."] if with_refinement else [])]
    numbers = [*(dataset.title for dataset in datasets), "Average", "Time"]
    text = TextTable(
        titles=facts + numbers,
        numeric=[True, *[False] * (len(facts) - 1), *[True] * len(numbers)],
        caption=f"{paper.title}: Table {table} of arXiv {source['arxiv']} ({source['venue']}), and ours",
        key=f"paper_table{table}",
        heading_column=0 if with_refinement else 1,
    )
    runs = _runs_by_cell(records)
    for section in paper.sections:
        text.rows.append(Heading(section.title))
        # The paper sets its best figures in bold in the first table only.
        plain = [[_PLAIN] * len(numbers)] * len(section.rows)
        ranked = _styles(section.rows) if with_refinement else plain
        for row, styles in zip(section.rows, ranked, strict=True):
            text.rows.append(_paper_line(row, styles, with_refinement))
            if row.ours or row.peer:
                ours = [_ours(_pick(runs, row, dataset.name), dataset) for dataset in datasets]
                text.rows += _our_lines(row, ours, text, len(facts))
    timing = paper_numbers()["timing"]
    text.remarks.append(
        f"AR in percent; time in seconds per image: the paper's on one {timing['gpu']}, with "
        f"{timing['cnos_seconds']} s of segmentation; ours as the runs recorded it, on their own machine."
    )
    known = {dataset.name for dataset in datasets}
    beside = sorted({f"{r.row} on {r.dataset}" for r in records if r.row and r.dataset not in known})
    if beside:
        text.remarks.append(f"Not in this table: {', '.join(beside)}.")
    return text.render(format)


def _runs_by_cell(records: Sequence[RunRecord]) -> dict[tuple[str, str], list[RunRecord]]:
    runs = defaultdict(list)
    for record in records:
        if record.row is not None:
            runs[record.row, record.dataset].append(record)
    return runs


def _pick(runs: dict[tuple[str, str], list[RunRecord]], row: PaperRow, dataset: str) -> list[RunRecord]:
    """Runs of a row, or else of the row of another table that is the same experiment."""
    own = runs.get((row.experiment, dataset))
    if own:
        return own
    same = [
        name for name, where in runs if where == dataset and find_paper_row(name).same_as == row.experiment
    ]
    return [run for name in [row.same_as, *same] if name for run in runs.get((name, dataset), [])]


def _ours(runs: Sequence[RunRecord], dataset: PaperDataset) -> _Ours:
    counting = [run for run in runs if run.counts]
    if len(counting) > 1:
        varied = ", ".join(varied_settings(counting)) or "nothing that is recorded"
        return _Ours(
            text=f"{len(counting)} runs",
            note=f"{len(counting)} runs of one row on one dataset, which differ in {varied}; give one of them.",
        )
    if counting:
        return _finished(counting[0], dataset)
    if runs:
        text, note = why_no_figures(runs)
        return _Ours(text=text, note=note)
    return _Ours()


def _finished(run: RunRecord, dataset: PaperDataset) -> _Ours:
    figures = run.figures
    recall, targets, time = figures.get("AR"), figures.get("targets"), figures.get("time_per_image")
    if recall is not None and targets == dataset.targets:
        return _Ours(percent=round(100 * recall, 1), time=time)
    errors = ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD")
    parts = [f"{name} {100 * figures[name]:.1f}" for name in errors if figures.get(name) is not None]
    lacking = [name for name in errors[1:] if figures.get(name) is None]
    why = [f"without {' and '.join(lacking)}"] if lacking else []
    if targets != dataset.targets:
        why.append(f"on {'an unknown number' if targets is None else targets} of {dataset.targets} targets")
    partial = f"Partial ({run.row}, {dataset.title}): {', '.join(parts) or 'no recall'}, {', '.join(why)}."
    return _Ours(note=partial, time=time)


def _our_lines(
    row: PaperRow, ours: list[_Ours], text: TextTable, num_facts: int
) -> list[list[Cell] | Heading]:
    """Lines below a row of the paper: ours, and the difference if there is any."""
    percents, times = [each.percent for each in ours], [each.time for each in ours]
    average, time = mean(percents), mean(times)
    cells = [
        Cell(each.text if each.percent is None else f"{each.percent:.1f}", text.note(each.note))
        for each in ours
    ]
    measured = [
        f"{dataset.title} {significant(seconds)} s"
        for dataset, seconds in zip(paper_datasets(), times, strict=True)
        if seconds is not None
    ]
    note = None
    if time is None and measured:
        note = text.note(f"Time ({row.experiment}), not on all seven datasets: {', '.join(measured)}.")
    cells += [Cell(_one_decimal(average)), Cell(_one_decimal(time), note)]
    blank = [Cell("")] * (num_facts - 2)
    lines: list[list[Cell] | Heading] = [[Cell(""), Cell("ours", style="italic"), *blank, *cells]]
    differences = [
        MISSING if a is None or b is None else _signed(round(a, 1) - b)
        for a, b in zip([*percents, average, time], _numbers(row), strict=True)
    ]
    if any(each != MISSING for each in differences):
        lines.append([Cell(""), Cell("difference", style="italic"), *blank, *map(Cell, differences)])
    return lines


def _numbers(row: PaperRow) -> list[float | None]:
    return [*row.average_recall.values(), row.average, row.time]


def _paper_line(row: PaperRow, styles: Sequence[Style], with_refinement: bool) -> list[Cell]:
    facts = [str(row.row), row.method]
    if with_refinement:
        facts += [row.refinement or MISSING, "✓" if row.no_training else "✗"]
    numbers = [
        Cell(_one_decimal(number), style=style) for number, style in zip(_numbers(row), styles, strict=True)
    ]
    return [*map(Cell, facts), *numbers]


def _styles(section: Sequence[PaperRow]) -> list[list[Style]]:
    """The paper sets the best figure of a section in bold and underlines the second best."""
    numbers = pd.DataFrame([_numbers(row) for row in section], dtype=float)
    numbers.iloc[:, :-1] *= -1  # the largest recall is the best, and the smallest time
    styles: dict[float, Style] = {1.0: "bold", 2.0: "underline"}
    return [
        [styles.get(rank, "plain") for rank in ranks] for ranks in numbers.rank(method="dense").to_numpy()
    ]


def _one_decimal(number: float | None) -> str:
    return MISSING if number is None else f"{number:.1f}"


def _signed(difference: float) -> str:
    # Adding zero makes −0.0 an ordinary 0.0.
    return f"{round(difference, 1) + 0.0:+.1f}".replace("-", "−")

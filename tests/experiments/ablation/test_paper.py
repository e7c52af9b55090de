"""The paper's numbers in the repository are those that the paper prints."""

import os
import re
from pathlib import Path

import pytest
import yaml

from ablation import find_paper_row, paper_datasets, paper_numbers, read_paper_table
from ablation.tables import _numbers, _styles

LABELS = {1: "tab:main_results", 2: "tab:ablations"}


@pytest.fixture(scope="module")
def latex() -> str:
    """The paper's source: FOUNDPOSE_PAPER, or a text in shared/seed beside the repository."""
    folder = Path(__file__).resolve().parents[4] / "shared" / "seed"
    given = os.environ.get("FOUNDPOSE_PAPER")
    for path in [Path(given)] if given else sorted(folder.glob("*.txt")):
        text = path.read_text(encoding="utf-8")
        if all(f"\\label{{{label}}}" in text for label in LABELS.values()):
            return text
    pytest.skip(f"no LaTeX source of the paper in {folder}; set FOUNDPOSE_PAPER to it")


def plain(cell: str) -> str:
    """Text of a LaTeX cell."""
    cell = re.sub(r"\\(Rowcolor|phantom|cite)\{[^}]*\}", "", cell.replace("\\;", " ").replace("\\,", " "))
    cell = re.sub(r"\\(textbf|underline|texttt)(?=\{)", "", cell).replace("--", "–")
    return re.sub(r"\s+", " ", re.sub(r"[{}]", "", cell)).strip()


def latex_rows(latex: str, table: int) -> list[list[str]]:
    """Raw cells of the rows of numbers of a table."""
    body = latex[: latex.index(f"\\label{{{LABELS[table]}}}")]
    body = body[body.rindex("\\begin{tabularx}") : body.rindex("\\bottomrule")]
    rows = [row.split("&") for row in body.split("\\\\")]
    rows = [[cell.split("\\midrule")[-1] for cell in row] for row in rows]
    return [row for row in rows if plain(row[0]).isdigit()]


def number(cell: str) -> float | None:
    text = plain(cell)
    return None if text == "–" else float(text)


@pytest.mark.parametrize("table", [1, 2])
def test_every_cell_is_as_in_the_papers_source(latex: str, table: int) -> None:
    rows = read_paper_table(table).rows
    printed = latex_rows(latex, table)
    assert len(printed) == len(rows) == {1: 17, 2: 11}[table]
    for cells, row in zip(printed, rows, strict=True):
        assert int(plain(cells[0])) == row.row
        # Capitals differ in one row of the paper ("Gigapose").
        assert plain(cells[1]).lower() == row.method.lower()
        assert [number(cell) for cell in cells[-9:]] == _numbers(row), row.experiment
        if table == 1:
            assert plain(cells[2]) == (row.refinement or "–")
            assert ("\\cmark" in cells[3]) is row.no_training
            assert ("\\xmark" in cells[3]) is not row.no_training
            assert ("Rowcolor" in cells[0]) is row.ours is (row.method == "FoundPose")


@pytest.mark.parametrize("table", [1, 2])
def test_columns_and_headings_are_as_in_the_papers_source(latex: str, table: int) -> None:
    body = latex[: latex.index(f"\\label{{{LABELS[table]}}}")]
    body = body[body.rindex("\\begin{tabularx}") :]
    columns = re.findall(r"\\rotatebox\[origin=lB\]\{90\}\{([^}]*)\}", body)
    assert columns[-9:] == [*(dataset.title for dataset in paper_datasets()), "Average", "Time"]
    headings = [plain(text) for text in re.findall(r"\\textit\{((?:[^{}]|\{[^}]*\})*)\}\}", body)]
    assert headings == [section.title for section in read_paper_table(table).sections]


def test_best_figures_are_set_as_in_the_papers_source(latex: str) -> None:
    rows = iter(latex_rows(latex, 1))
    for section in read_paper_table(1).sections:
        for row, styles in zip(section.rows, _styles(section.rows), strict=True):
            cells = next(rows)[-9:]
            printed = [
                "bold" if "\\textbf" in cell else "underline" if "\\underline" in cell else "plain"
                for cell in cells
            ]
            assert styles == printed, row.experiment


def test_sweeps_and_memory_are_as_in_the_papers_source(latex: str) -> None:
    sweeps, memory = paper_numbers()["sweeps"], paper_numbers()["memory"]
    for words, key in (
        ("templates", "templates"),
        ("PCA components", "pca_components"),
        ("visual words", "visual_words"),
        ("RANSAC iterations", "ransac_iterations"),
    ):
        match = re.search(rf"{words} \(([\d, ]+)\)", latex)
        assert match is not None
        assert [int(value) for value in match[1].split(",")] == sweeps[key]
    section = latex[latex.index("\\myparagraph{Memory requirements.}") :][:2000]
    large, small = memory["representations"]
    osop, other = memory["others"]["OSOP"], memory["others"]["Sundermeyer et al."]
    for phrase in (
        f"around {memory['patches_per_template']} valid patches per template, patch descriptors projected to a "
        f"{large['dimensions']}$d$ PCA space, and {memory['bytes_per_scalar']}B per scalar",
        f"take {memory['descriptors_kb_per_template']}kB per template. With {large['words']} visual words",
        f"an additional {memory['bag_of_words_kb_per_template']}kB per template",
        f"built from {large['templates']} templates takes {large['printed_mb']}MB",
        f"{osop['times_ours']}X less memory",
        f"{osop['gb_per_object']}GB per object ({osop['dimensions']}$d$ vector for each of {osop['templates']}",
        f"sub {small['largest_ar_drop']:g}\\;AR drop",
        f"{small['printed_mb']}MB with {small['templates']} templates, {small['dimensions']}$d$ PCA space, and "
        f"{small['words']} visual words",
        f"requires {other['mb_per_object']}MB per object, but its accuracy is {other['ar_difference']} AR lower",
        f"use {memory['others']['GigaPose']['templates']} and {memory['others']['ZS6D']['templates']} templates",
    ):
        assert phrase in section
    seconds, timing = paper_numbers()["retrieval_seconds"], paper_numbers()["timing"]
    assert f"({seconds['patch_matching']}s vs {seconds['bag_of_words']}s per query" in latex
    assert f"CNOS segmentation stage that takes around {timing['cnos_seconds']}\\,s per image" in latex
    assert "P100 16GB used in our experiments" in latex
    assert timing["gpu"] == "NVIDIA P100 16 GB"


def test_averages_are_those_of_the_datasets() -> None:
    off = []
    for row in (*read_paper_table(1).rows, *read_paper_table(2).rows):
        values = list(row.average_recall.values())
        present = [value for value in values if value is not None]
        if row.average is None:
            assert len(present) < len(values)
        # Cells and average were rounded each for itself.
        elif abs(sum(present) / 7 - row.average) > 0.1:
            off.append(row.experiment)
    # The paper's own average of GigaPose is lower than its cells say.
    assert off == ["table1_row15"]


def test_rows_are_found_by_the_names_of_their_experiments() -> None:
    for table in (1, 2):
        for row in read_paper_table(table).rows:
            assert find_paper_row(row.experiment) is row
    assert find_paper_row("table1_row07").refinement == "Featuremetric"
    twin = find_paper_row("table2_row01")
    assert twin.same_as is not None
    assert find_paper_row(twin.same_as).average_recall == twin.average_recall


@pytest.mark.parametrize("name", ["table1_row18", "table3_row01", "table1_row7", "oracle", ""])
def test_other_names_are_no_rows(name: str) -> None:
    with pytest.raises(ValueError, match="named such as table1_row07"):
        find_paper_row(name)


def test_there_is_no_third_table() -> None:
    with pytest.raises(ValueError, match=r"one of \[1, 2\], got 3"):
        read_paper_table(3)


def test_the_numbers_have_their_source() -> None:
    numbers = paper_numbers()
    assert numbers["source"]["arxiv"] == "2311.18809"
    parts = [*numbers["tables"].values(), numbers["sweeps"], numbers["memory"], numbers["timing"]]
    assert all(part["source"].startswith(("Table", "Section")) for part in parts)
    assert yaml.safe_dump(numbers)

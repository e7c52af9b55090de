import re
from itertools import pairwise

import pytest

from ablation import RunRecord, paper_datasets, paper_table, read_paper_table, sweep_table
from ablation.text_tables import Cell, Heading, TextTable, escape_latex
from tests.experiments.ablation.runs import markdown_rows, row_run, sweep_run

NAMES = [dataset.name for dataset in paper_datasets()]


def _mixed() -> list[RunRecord]:
    """Something of everything that a table has to show."""
    partial = {"AR": None, "AR_VSD": None, "AR_MSSD": 0.41, "AR_MSPD": 0.525}
    return [
        row_run("table1_row01", "lmo", 0.381, figures={"time_per_image": 2.0}),
        row_run("table1_row01", "tless", figures=partial),
        row_run("table1_row01", "tudl", 0.5, figures={"targets": 200}),
        row_run("table1_row12", "lmo", 0.9, label="random weights, figures mean nothing."),
        row_run(
            "table1_row12",
            "hb",
            status="failed",
            error="Traceback:\nOSError: 100% of a_b | <c> & {d} #1 ~ ^ $ \\",
        ),
        row_run("table1_row12", "ycbv", 0.1, settings={"seed": 0}),
        row_run("table1_row12", "ycbv", 0.2, settings={"seed": 1}),
        row_run("table1_row12", "hope", 0.2),
    ]


def _line(text: str, row: int, offset: int) -> list[str]:
    """The row of the paper, or the line that is so many lines below it."""
    rows = markdown_rows(text)
    at = next(i for i, cells in enumerate(rows) if cells[0] == str(row))
    return rows[at + offset]


@pytest.mark.parametrize("table", [1, 2])
def test_without_runs_the_table_is_the_papers(table: int) -> None:
    paper = read_paper_table(table)
    rows = markdown_rows(paper_table([], table))
    printed = {cells[0]: cells for cells in rows if cells[0].isdigit()}
    assert list(printed) == [str(row.row) for row in paper.rows]
    for row in paper.rows:
        numbers = [*row.average_recall.values(), row.average, row.time]
        assert printed[str(row.row)][-9:] == ["–" if each is None else f"{each:.1f}" for each in numbers]
    ours = [cells for cells in rows if "*ours*" in cells]
    assert len(ours) == sum(row.ours or row.peer for row in paper.rows) == {1: 11, 2: 11}[table]
    assert all(cells[-9:] == ["–"] * 9 for cells in ours)
    assert not any("*difference*" in cells for cells in rows)
    headings = [
        cells for cells in rows if any(cell.startswith("*") and cell.endswith(":*") for cell in cells)
    ]
    assert [next(filter(None, cells)).strip("*") for cells in headings] == [s.title for s in paper.sections]


def test_complete_figures_stand_beside_the_papers_with_difference_average_and_time() -> None:
    shares = [0.4004, 0.41, 0.5672, 0.283, 0.26, 0.6, 0.5]
    records = [
        row_run("table1_row07", name, share, figures={"time_per_image": 1.0 + i})
        for i, (name, share) in enumerate(zip(NAMES, shares, strict=True))
    ]
    text = paper_table(records, 1)
    assert _line(text, 7, 1)[4:] == ["40.0", "41.0", "56.7", "28.3", "26.0", "60.0", "50.0", "43.1", "4.0"]
    assert _line(text, 7, 2)[4:] == ["+0.5", "+1.4", "+0.0", "+0.0", "−0.2", "+1.5", "+0.3", "+0.5", "+1.4"]
    assert "¹" not in text


def test_an_average_needs_all_seven_datasets() -> None:
    text = paper_table([row_run("table1_row07", name, 0.4) for name in NAMES[:6]], 1)
    assert _line(text, 7, 1)[4:] == ["40.0"] * 6 + ["–", "–", "–"]
    assert _line(text, 7, 2)[-3:] == ["–", "–", "–"]


def test_what_is_no_full_figure_is_in_a_note() -> None:
    text = paper_table(_mixed(), 1)
    assert _line(text, 1, 1)[4:] == ["38.1", "–¹", "–²", "–", "–", "–", "–", "–", "–³"]
    assert _line(text, 1, 2)[4:] == ["−1.5"] + ["–"] * 8
    assert _line(text, 12, 1)[4:] == ["runs⁴", "–", "–", "–", "–", "failed⁵", "2 runs⁶", "–", "–"]
    assert _line(text, 13, 0)[1] == "FoundPose"  # no line of differences
    notes = text.splitlines()
    assert "¹ Partial (table1_row01, T-LESS): AR_MSSD 41.0, AR_MSPD 52.5, without AR_VSD." in notes
    assert any(
        note.startswith("² Partial (table1_row01, TUD-L): AR 50.0,") and "200 of 600" in note
        for note in notes
    )
    assert "³ Time (table1_row01), not on all seven datasets: LM-O 2.00 s." in notes
    assert "⁴ It runs; no figures are given: random weights, figures mean nothing." in notes
    assert any(note.startswith("⁵ Failed: OSError: 100% of a_b") for note in notes)
    assert any(note.startswith("⁶ 2 runs") and "differ in seed" in note for note in notes)
    assert "Not in this table: table1_row12 on hope." in notes
    assert "90.0" not in text  # of the random weights


def test_targets_that_nobody_counted_make_no_figure_of_the_benchmark() -> None:
    text = paper_table([row_run("table2_row03", "lmo", 0.35, figures={"targets": None})], 2)
    assert _line(text, 3, 1)[2] == "–¹"
    assert "on an unknown number of 1445 targets" in text


def test_a_row_that_both_tables_have_is_run_once() -> None:
    records = [row_run("table1_row01", "lmo", 0.38)]
    assert _line(paper_table(records, 2), 1, 1)[2] == "38.0"
    own = [*records, row_run("table2_row01", "lmo", 0.37)]
    assert _line(paper_table(own, 2), 1, 1)[2] == "37.0"
    assert _line(paper_table(own, 1), 1, 1)[4] == "38.0"


def test_a_good_run_makes_up_for_a_failed_one() -> None:
    failed = row_run("table2_row06", "lmo", status="failed", error="out of memory")
    assert _line(paper_table([failed, row_run("table2_row06", "lmo", 0.03)], 2), 6, 1)[2] == "3.0"


def test_unknown_tables_and_formats_are_refused() -> None:
    with pytest.raises(ValueError, match="got 3"):
        paper_table([], 3)
    with pytest.raises(ValueError, match="markdown or latex, got 'html'"):
        paper_table([], 1, format="html")  # type: ignore[arg-type]


def check_markdown(text: str) -> None:
    """Every line of the table is as wide as the others, and no row has more cells than the title."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1
    counts = [len(re.findall(r"(?<!\\)\|", line)) for line in lines]
    assert max(counts) == counts[0] == counts[1]
    assert re.fullmatch(r"\|(:?-+:?\|)+", lines[1])


def check_latex(text: str) -> None:
    """Environments, braces and dollars are balanced; every row fills the columns; only ASCII is left."""
    assert text.isascii()
    opened: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    bare = re.sub(r"\\[\\{}$&%#_]", "  ", text.split("\n", 1)[1])
    depth = 0
    for sign in bare:
        depth += {"{": 1, "}": -1}.get(sign, 0)
        assert depth >= 0
    assert depth == 0
    assert not re.search(r"[%#_^~]", re.sub(r"\\label\{[^}]*\}|\}~", "", bare))
    assert bare.count("$") % 2 == 0
    match = re.search(r"\\begin\{tabular\}\{([lr]+)\}\n(.*)\\end\{tabular\}", text, re.DOTALL)
    assert match is not None
    lines = [line.strip() for line in match[2].splitlines() if line.strip()]
    rules = [line for line in lines if line.endswith("rule")]
    assert rules[0] == "\\toprule"
    assert rules[-1] == "\\bottomrule"
    assert set(rules[1:-1]) == {"\\midrule"}
    assert not any(a == b == "\\midrule" for a, b in pairwise(lines))
    for line in set(lines) - set(rules):
        assert line.endswith(" \\\\")
        spans = [int(span) for span in re.findall(r"\\multicolumn\{(\d+)\}", line)]
        filled = len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) - len(spans)
        assert filled == len(match[1]), line


@pytest.mark.parametrize("table", [1, 2])
@pytest.mark.parametrize("mixed", [False, True])
def test_both_formats_are_well_formed(table: int, mixed: bool) -> None:
    records = _mixed() if mixed else []
    check_markdown(paper_table(records, table))
    text = paper_table(records, table, format="latex")
    check_latex(text)
    assert f"\\label{{tab:paper_table{table}}}" in text
    assert ("\\textbf{39.6}" in text) is (table == 1)
    if mixed and table == 1:
        assert "--\\rlap{\\textsuperscript{1}}" in text
        assert r"100\% of a\_b \textbar{} \textless{}c\textgreater{} \& \{d\} \#1" in text


def test_latex_and_markdown_say_the_same() -> None:
    markdown = [cells for cells in markdown_rows(paper_table(_mixed(), 1)) if len(cells) == 13]
    latex = paper_table(_mixed(), 1, format="latex")
    numbers = [
        re.findall(r"(?<![\d{])\d+\.\d", re.sub(r"\\(textbf|underline)\{([\d.]+)\}", r"\2", line))
        for line in latex.splitlines()
        if line.endswith("\\\\")
    ]
    expected = [re.findall(r"\d+\.\d", " ".join(cells[4:])) for cells in markdown]
    assert [each for each in numbers if each] == [each for each in expected if each]


def _sweep() -> list[RunRecord]:
    return [
        sweep_run(
            {"words.num_words": words, "extractor.layer": layer, "seed": seed},
            {
                "AR_MSPD": 0.5 + layer / 100 + seed / 50,
                "time_per_image": words / 3,
                "memory.total": words * 2**20,
            },
        )
        for words in (4096, 512, 1024)
        for layer in (18, 9)
        for seed in (0, 1)
    ]


def test_a_sweep_has_a_row_for_each_combination_in_numeric_order() -> None:
    text = sweep_table(_sweep(), ["words.num_words", "extractor.layer"])
    check_markdown(text)
    rows = markdown_rows(text)
    assert rows[0] == [
        *("words.num_words", "extractor.layer", "AR_MSPD (%)", "time_per_image (s)", "memory.total (MiB)")
    ]
    assert [row[:2] for row in rows[2:]] == [[w, n] for w in ("512", "1024", "4096") for n in ("9", "18")]
    assert rows[2][2:] == ["60.0¹", "171¹", "512.0¹"]  # the mean of two seeds
    assert rows[-1][2:] == ["69.0¹", "1365¹", "4096.0¹"]
    assert "¹ Mean of 2 runs, which differ in seed." in text


def test_a_sweep_shows_what_is_missing_failed_or_means_nothing() -> None:
    records = [
        sweep_run({"refiner": None}, {"AR": 0.5, "AR_MSPD": 0.5}),
        sweep_run({"refiner": "a"}, {"AR": None, "AR_MSPD": 0.5}),
        sweep_run({"refiner": "b"}, {}, status="failed", error="boom"),
        sweep_run({"refiner": "c"}, {"AR": 0.123}, label="random weights"),
    ]
    text = sweep_table(records, ["refiner"], figures=["AR", "AR_MSPD"])
    assert [row[1:] for row in markdown_rows(text)[2:]] == [
        ["50.0", "50.0"],
        ["–", "50.0"],
        ["failed¹", "failed¹"],
        ["runs²", "runs²"],
    ]
    assert [row[0] for row in markdown_rows(text)[2:]] == ["–", "a", "b", "c"]
    assert "12.3" not in text
    check_latex(sweep_table(records, ["refiner"], format="latex"))


def test_datasets_are_kept_apart() -> None:
    records = [sweep_run({"h": 5}, {"AR": 0.1}), sweep_run({"h": 5}, {"AR": 0.3}, dataset="hb")]
    assert markdown_rows(sweep_table(records, ["h"]))[2:] == [["hb", "5", "30.0"], ["lmo", "5", "10.0"]]


def test_a_sweep_needs_runs_and_keys_that_they_have() -> None:
    with pytest.raises(
        ValueError, match=r"settings that vary: \['extractor.layer', 'seed', 'words.num_words'\]"
    ):
        sweep_table(_sweep(), ["word_count"])
    with pytest.raises(ValueError, match="needs runs and keys"):
        sweep_table([], ["seed"])
    with pytest.raises(ValueError, match="needs runs and keys"):
        sweep_table(_sweep(), [])


def test_rows_must_fit_the_columns() -> None:
    table = TextTable(["a", "b"], [False, True], [Heading("all"), [Cell("1")]])
    with pytest.raises(ValueError, match="1 cells, the table 2 columns"):
        table.render("latex")


def test_signs_that_mean_something_are_escaped() -> None:
    assert escape_latex("a_b\n{c}\\") == r"a\_b \{c\}\textbackslash{}"
    table = TextTable(["a|b"], [False], [[Cell("x|*y*", style="italic")]])
    check_markdown(table.render("markdown"))
    assert r"*x\|\*y\**" in table.render("markdown")

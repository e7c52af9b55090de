import csv
import json
from pathlib import Path

import pandas as pd
import pytest

from ablation import RunRecord, collect_runs, tidy, varied_settings, write_tidy
from tests.experiments.ablation.runs import sweep_run


def _some() -> list[RunRecord]:
    return [
        sweep_run({"words.num_words": 1024, "seed": 0, "ids": [1, 5]}, {"AR": None, "AR_MSPD": 0.1 + 0.2}),
        sweep_run({"words.num_words": 2048, "pca": True}, {}, status="failed", error='a "bad", wolf\nhowls'),
        sweep_run({"words.num_words": "x"}, {"AR_MSPD": 1, "memory.total": 2**40}, label="random weights"),
    ]


def test_a_record_comes_back_from_its_folder(tmp_path: Path) -> None:
    for i, record in enumerate(_some()):
        record.write(tmp_path / f"run{i}")
    read = collect_runs(tmp_path)
    assert [record.folder for record in read] == [tmp_path / f"run{i}" for i in range(3)]
    for record, expected in zip(read, _some(), strict=True):
        assert {**record.__dict__, "folder": None} == expected.__dict__
    assert [record.counts for record in read] == [True, False, False]


def test_the_file_has_the_agreed_entries(tmp_path: Path) -> None:
    path = sweep_run({"seed": 1}, {"AR": 0.5}, row="table1_row07").write(tmp_path)
    assert path == tmp_path / "run.json"
    assert json.loads(path.read_text()) == {
        "name": "sweep",
        "row": "table1_row07",
        "dataset": "lmo",
        "status": "finished",
        "error": None,
        "label": None,
        "settings": {"seed": 1},
        "figures": {"AR": 0.5},
    }


def test_half_written_and_foreign_files_are_left_out_and_named(tmp_path: Path) -> None:
    good = sweep_run({}, {"AR": 0.5})
    good.write(tmp_path / "a" / "good")
    text = (tmp_path / "a" / "good" / "run.json").read_text()
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / ".run-xyz.json").write_text(text[:20])
    broken = {
        "half": text[: len(text) // 2],
        "list": "[]",
        "foreign": '{"status": "finished"}',
        "unknown": text.replace('"finished"', '"running"'),
        "lists": text.replace('"settings": {}', '"settings": []'),
    }
    for name, content in broken.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text(content)
    with pytest.warns(UserWarning, match="a run is left out") as caught:
        records = collect_runs(tmp_path)
    assert [record.folder for record in records] == [tmp_path / "a" / "good"]
    warned = sorted(str(each.message) for each in caught)
    assert len(warned) == len(broken)
    assert all(any(f"{tmp_path / name}/run.json" in message for message in warned) for name in broken)


def test_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no folder of runs"):
        collect_runs(tmp_path / "none")
    assert collect_runs(tmp_path) == []


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"status": "done"}, "finished or failed, got 'done'"),
        ({"row": "table1_row99"}, "table1_row99"),
        ({"figures": {"status": 1, "AR": 0.1}}, "must not be named status"),
    ],
)
def test_bad_facts_are_refused(facts: dict, message: str) -> None:
    given = {"name": None, "row": None, "dataset": "lmo", "status": "finished"} | facts
    with pytest.raises(ValueError, match=message):
        RunRecord(**given)


def test_tidy_has_every_setting_and_figure_in_every_row() -> None:
    table = tidy(_some())
    rows = table.to_dict("records")
    assert list(table.columns) == [
        *("name", "row", "dataset", "status", "error", "label", "folder"),
        *("AR", "AR_MSPD", "memory.total"),
        *("settings.ids", "settings.pca", "settings.seed", "settings.words.num_words"),
    ]
    assert [row["settings.words.num_words"] for row in rows] == [1024, 2048, "x"]
    assert [row["settings.pca"] for row in rows] == [None, True, None]
    assert rows[0]["settings.ids"] == "[1, 5]"
    assert rows[0]["AR_MSPD"] == 0.1 + 0.2


def test_csv_keeps_every_digit_and_every_text(tmp_path: Path) -> None:
    path = write_tidy(_some(), tmp_path / "sub" / "results.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3
    assert float(rows[0]["AR_MSPD"]) == 0.1 + 0.2
    assert rows[0]["AR"] == ""
    assert rows[1]["error"] == 'a "bad", wolf\nhowls'
    assert rows[1]["settings.pca"] == "true"
    assert int(rows[2]["memory.total"]) == 2**40
    assert [each.name for each in path.parent.iterdir()] == ["results.csv"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_tidy(_some()[:1], tmp_path / "results.csv")
    before = path.read_bytes()

    def interrupted(self: pd.DataFrame, file: Path, **_: object) -> None:
        file.write_text("half a")
        raise KeyboardInterrupt

    monkeypatch.setattr(pd.DataFrame, "to_csv", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_tidy(_some(), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_no_runs_are_no_table(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no runs"):
        write_tidy([], tmp_path / "results.csv")


def test_varied_settings() -> None:
    records = [sweep_run({"a": 1, "b": [1], "c": None}, {}), sweep_run({"a": 2, "b": [1]}, {})]
    assert varied_settings(records) == ["a", "c"]
    assert varied_settings([]) == []

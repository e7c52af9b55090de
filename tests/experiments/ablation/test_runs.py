import csv
import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from ablation import RunRecord, collect_runs, run_once
from ablation.runs import _telling_apart, run_folder, run_settings, varied_alone
from tests.experiments.test_apps import SMALL, run_app
from tests.test_config import load

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def arguments(tiny_bop):
    small = ["viewpoints.count=20", "words.num_words=32", "crop.size=140", "projection.num_components=32"]
    return ["extractor=dense_sift", f"data.root={tiny_bop}", "masks=gt", *small, "trainer.accelerator=cpu"]


def test_settings_are_literal_and_once():
    settings = run_settings(load("ablate", "extractor=dense_sift", "words.num_words=77"))
    assert settings["words.num_words"] == 77
    assert settings["descriptors.sigma"] == 0.3
    assert settings["onboarder.idf_mode"] == "document"
    assert "onboarder.words.num_words" not in settings
    assert "bow.sigma" not in settings
    assert not any(key.startswith(("folder", "representations", "hydra")) for key in settings)


def test_folders_tell_settings_apart_and_nothing_else(tmp_path):
    def folder(*overrides):
        return run_folder(load("ablate", f"folder={tmp_path}", *overrides))

    base = folder()
    same = ["trainer.devices=4", "device=cuda", "representations=elsewhere", "method=other", "errors=[mssd]"]
    assert folder(*same, "data_module.num_workers=3", "memory_limit=100") == base
    assert folder("pnp.iterations=200") != base
    assert folder("descriptors.sigma=3") != base
    assert folder("data.split=val") != base
    assert folder("data.root=/somewhere/lmo").name.startswith("lmo-")
    # Two rows of the paper that are one experiment, and a default that is spelled out.
    row = folder("experiment=table1_row01", "data.root=/x")
    assert folder("experiment=table2_row01", "data.root=/x") == row
    assert folder("experiment=table1_row01", "data.root=/x", "masks.path=/x/detections/cnos-fastsam") == row


def test_what_only_evaluate_does_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"evaluate.py trainer=ddp"):
        run_once(load("ablate", f"folder={tmp_path}", "trainer=ddp"))
    with pytest.raises(ValueError, match=r"evaluate.py results="):
        run_once(load("ablate", f"folder={tmp_path}", "results=x.csv"))
    assert list(tmp_path.iterdir()) == []


def test_a_row_with_other_settings_is_not_that_row(tmp_path, monkeypatch):
    monkeypatch.setattr("foundpose.evaluation.run.run_evaluation", lambda cfg, folder: None)
    monkeypatch.setattr("ablation.runs._figures", lambda folder: {"AR": 0.5})

    def row(*overrides):
        given = ["experiment=table1_row01", *overrides]
        return run_once(load("ablate", f"folder={tmp_path}", *given), "table1_row01", given).row

    assert row() == "table1_row01"
    assert row("data=tless", "trainer.accelerator=cpu", "max_images=3") == "table1_row01"
    assert row("words.num_words=64") is None
    assert row("extractor=dense_sift") is None


def test_a_finished_run_is_done_again_only_for_other_errors(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("foundpose.evaluation.run.run_evaluation", lambda cfg, folder: calls.append(folder))
    monkeypatch.setattr("ablation.runs._figures", lambda folder: {"AR": 0.5})
    cfg = load("ablate", f"folder={tmp_path}", "errors=[mssd]")
    run_once(cfg)
    run_once(cfg)
    assert len(calls) == 1
    run_once(load("ablate", f"folder={tmp_path}", "errors=[mssd,mspd]"))
    assert len(calls) == 2
    assert calls[0] == calls[1]


def test_a_killed_run_is_listed(tmp_path, monkeypatch):
    def killed(cfg, folder):
        raise KeyboardInterrupt

    monkeypatch.setattr("foundpose.evaluation.run.run_evaluation", killed)
    with pytest.raises(KeyboardInterrupt):
        run_once(load("ablate", f"folder={tmp_path}"))
    (record,) = collect_runs(tmp_path / "runs")
    assert (record.status, record.error) == ("failed", "it was started and has not ended")


def run(**settings):
    return RunRecord(None, None, "tiny", "finished", settings=settings, figures={"AR": 0.5})


def test_runs_that_differ_in_one_setting():
    runs = [run(a=1, b=1), run(a=2, b=1), run(a=1, b=2), run(a=3, b=3)]
    assert varied_alone(runs, "a") == [[runs[0], runs[1]]]
    assert varied_alone(runs, "b") == [[runs[0], runs[2]]]
    assert varied_alone(runs[:1], "a") == []


def test_few_settings_tell_groups_apart():
    groups = [
        [run(**{"extractor._target_": e, "extractor.size": e, "h": h, "words": 1})]
        for e in "ab"
        for h in (1, 5)
    ]
    assert _telling_apart(groups, "words") == ["extractor._target_", "h"]
    assert _telling_apart(groups[:2], "words") == ["h"]
    assert _telling_apart(groups[:1], "words") == []


@pytest.mark.slow
def test_a_sweep_from_the_command_line(arguments, tmp_path, monkeypatch, capsys):
    """Runs are cached, shared, reported; a failed one stops no other and is tried again."""
    folder = tmp_path / "ablate"

    def sweep(*overrides):
        """What it prints; one run has failed."""
        with pytest.raises(SystemExit) as stop:
            run_app(monkeypatch, "ablate", "-m", *arguments, f"folder={folder}", *overrides)
        assert stop.value.code == 1
        return capsys.readouterr().out

    # More PCA components than there are channels cannot work.
    printed = sweep("projection.num_components=16,999,32")
    records = collect_runs(folder / "runs")
    by_components = {r.settings["projection.num_components"]: r for r in records}
    assert {k: r.status for k, r in by_components.items()} == {
        16: "finished",
        999: "failed",
        32: "finished",
    }
    assert by_components[999].error.startswith("ValueError: num_components is 999 but the extractor's")
    assert "ValueError" in (by_components[999].folder / "error.txt").read_text()
    assert "1 failed" in printed
    figures = by_components[32].figures
    assert figures["targets"] == 3
    assert 0 <= figures["AR_MSPD"] <= 1
    assert figures["seconds_per_instance.pnp"] > 0
    assert figures["memory.descriptors"] == pytest.approx(2 * by_components[16].figures["memory.descriptors"])

    with (folder / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows].count("finished") == 2
    for name in ("table1.md", "table1.tex", "table2.md", "sweep_projection_num_components.md", "memory.md"):
        assert (folder / "tables" / name).stat().st_size > 100
    assert (folder / "plots" / "projection_num_components.png").stat().st_size > 5_000

    # Nothing that is finished is repeated, and nothing that is shared is made again.
    finished = [record.folder / "scores.json" for record in records if record.status == "finished"]
    before = {path: path.stat().st_mtime_ns for path in [*folder.rglob("*.safetensors"), *finished]}
    printed = sweep("projection.num_components=16,32", "pnp.iterations=400,50", "launcher=joblib")
    assert "4 runs finished, 1 failed" in printed
    assert [r.status for r in collect_runs(folder / "runs") if r.settings["pnp.iterations"] == 50] == [
        *("finished", "finished")
    ]
    after = {path: path.stat().st_mtime_ns for path in [*folder.rglob("*.safetensors"), *finished]}
    assert after == before


@pytest.mark.slow
def test_a_single_run_of_an_experiment(tiny_bop, representations, tmp_path, monkeypatch, capsys):
    run_app(
        monkeypatch,
        "ablate",
        "experiment=oracle",
        f"data.root={tiny_bop}",
        "masks=gt",
        *SMALL,
        "trainer.accelerator=cpu",
        f"folder={tmp_path}",
        f"representations={representations}",
    )
    (record,) = collect_runs(tmp_path / "runs")
    assert record.name == "oracle"
    assert record.label is None
    assert record.figures["AR_MSPD"] > 0.9
    assert "1 runs finished, 0 failed" in capsys.readouterr().out
    assert json.loads((record.folder / "scores.json").read_text())["targets"] == 3


def test_workers_of_a_launcher_find_what_lies_beside_the_app(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    runpy.run_path(str(ROOT / "experiments" / "ablate.py"), run_name="ablate")
    code = "import importlib.util, os; print(importlib.util.find_spec('ablation').origin, os.environ['PYTHONPATH'])"
    worker = [sys.executable, "-c", code]
    told = subprocess.run(worker, capture_output=True, text=True, check=True, cwd=ROOT / "tests").stdout
    origin, path = told.split()
    assert Path(origin) == ROOT / "experiments" / "ablation" / "__init__.py"
    assert path.endswith("elsewhere")

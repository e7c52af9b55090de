"""The check that is meant for a GPU, rehearsed on the CPU."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from benchmarking.gpu import Outcome, load_part, run_part, run_parts, write_page
from foundpose.config import load_config

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["quick=true", "device=cpu", "extractors=[vits14]", "precisions=[float32]", "batch_sizes=[2]"]


def config(*overrides):
    return load_config("gpu_check", [*SMALL, "instances_per_image=1", *overrides])


@pytest.mark.slow
def test_parts_and_their_page(tmp_path):
    names = ["onboarding", "dataset", "agreement", "benchmark vits14 float32"]
    for name in names:
        run_part(config(f"part='{name}'"), tmp_path / name)
    outcomes = [Outcome(name, "ran", 1.0, load_part(tmp_path / name)) for name in names]
    page, _ = write_page(config(), outcomes, tmp_path)
    content = json.loads((tmp_path / "gpu_check.json").read_text())
    checks = {check["name"]: check for check in content["checks"]}
    assert checks["agreement: poses as on the CPU"]["value"] == 100.0
    assert checks["onboarding: onboarding of one object"]["value"] > 0
    assert checks["dataset: 1 batches of 2 instances, refined"]["value"] > 0
    assert any(name.startswith("benchmark vits14 float32: all coarse stages") for name in checks)
    assert (tmp_path / "gpu_check.md").read_text() == page
    assert "| agreement: poses as on the CPU" in page


def test_parts_that_fail_leave_the_others_alone(tmp_path):
    app = tmp_path / "app.py"
    app.write_text(
        "import sys, pathlib, time\n"
        "part, folder = (argument.partition('=')[2].strip(chr(39)) for argument in sys.argv[-2:])\n"
        "if part == 'tests': sys.exit(3)\n"
        "if part == 'onboarding': time.sleep(60)\n"
        "(pathlib.Path(folder) / 'part.json').write_text('{\"checks\": []}')\n"
    )
    cfg = config("parts=[tests,onboarding,agreement]", "part_seconds=2")
    outcomes = run_parts(cfg, app, [], tmp_path)
    assert [outcome.status.split(",")[0] for outcome in outcomes] == [
        "failed with status 3",
        "stopped after 2 s",
        "ran",
    ]
    assert not write_page(cfg, outcomes, tmp_path)[1]
    late = run_parts(config("parts=[agreement]", "seconds=-1"), app, [], tmp_path)
    assert late[0].status == "no time left"


def test_wrong_parts(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_check.py", "parts=[cooking]", f"hydra.run.dir={tmp_path}"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "experiments" / "gpu_check.py"), run_name="__main__")
    assert stopped.value.code == 2
    assert "got 'cooking'" in capsys.readouterr().err

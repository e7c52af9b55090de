import subprocess
import sys
from pathlib import Path

import pytest

import foundpose
from foundpose import cli


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "foundpose.cli", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_help_shows_each_command_with_a_line_and_an_example(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["foundpose", "--help"])
    cli.main()
    shown = capsys.readouterr().out
    for name in cli.apps():
        assert f"\n  {name} " in shown
        assert f"foundpose {name}" in shown


def test_info_names_versions_and_folders(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("FOUNDPOSE_CACHE", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["foundpose", "info"])
    cli.main()
    shown = capsys.readouterr().out
    assert f"{tmp_path / 'weights'}: none" in shown
    for name in ("torch", "kornia", "GPUs"):
        assert name in shown


def test_unknown_command_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["foundpose", "estimat"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "no command 'estimat'; there are ablate, " in capsys.readouterr().err


def test_a_command_takes_overrides_and_its_exit_status_counts(tmp_path: Path) -> None:
    shown = run(
        "estimate", "image=missing.png", "mesh=cup.ply", "box=[0,0,9,9]", "intrinsics=[9,9,9,9]", cwd=tmp_path
    )
    assert shown.returncode == 2
    assert shown.stderr.startswith("error: ")
    assert "missing.png" in shown.stderr
    assert "Traceback" not in shown.stderr


def test_load_composes_the_default_with_overrides() -> None:
    method = foundpose.load(overrides=["extractor=dense_sift", "refiner=featuremetric", "viewpoints.count=7"])
    assert type(method.pipeline.extractor).__name__ == "DenseSift"
    assert type(method.pipeline.refiner).__name__ == "FeaturemetricRefiner"
    assert method.onboarder.extractor is method.pipeline.extractor


@pytest.mark.slow
def test_the_base_installation_is_enough_for_what_needs_no_extra(tmp_path: Path) -> None:
    code = (
        "import runpy, sys\n"
        "class Lacking:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in LACKING:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        f"LACKING = {[*cli.EXTRAS, 'pyrender']!r}\n"
        "sys.meta_path.insert(0, Lacking())\n"
        "from foundpose import cli\n"
        "sys.path.insert(0, str(cli.apps()['demo'].parent))\n"
        "for name in ('demo', 'estimate', 'onboard', 'check', 'view'):\n"
        "    runpy.run_path(str(cli.apps()[name]), run_name='imported')\n"
        "print('imported')\n"
        "sys.argv = ['foundpose', 'evaluate']\n"
        "cli.main()\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert ran.stdout == "imported\n", ran.stderr
    assert ran.returncode == 2
    assert ran.stderr.splitlines()[-1].endswith("pip install 'foundpose[evaluate]'")

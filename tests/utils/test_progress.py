import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

from foundpose.utils.progress import ProgressBars, say, track

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [p for folder in ("experiments", "foundpose") for p in sorted((ROOT / folder).rglob("*.py"))]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown_by(monkeypatch, function, stream):
    """What a function writes to standard error."""
    # Not in a fixture: pytest changes the streams once more before a test begins.
    monkeypatch.setattr(sys, "stderr", stream)
    function()
    return stream.getvalue()


def work():
    bars = ProgressBars("cup")
    for done in (1, 3, 5):
        bars("templates", done, 5)
    assert list(track([1, 2, 3], "pictures")) == [1, 2, 3]
    assert list(track(iter([1, 2]), "scenes", 2)) == [1, 2]


def test_a_terminal_sees_stage_rate_and_time_left(monkeypatch):
    monkeypatch.delenv("FOUNDPOSE_PROGRESS", raising=False)
    shown = shown_by(monkeypatch, work, Terminal())
    assert "cup templates: 100%" in shown
    assert "pictures: 100%" in shown
    assert "scenes: 100%" in shown
    assert re.search(r"5/5 \[\d\d:\d\d<\d\d:\d\d, .*(it/s|s/it)\]", shown)


def test_no_bars_where_there_is_no_terminal(monkeypatch):
    monkeypatch.delenv("FOUNDPOSE_PROGRESS", raising=False)
    assert shown_by(monkeypatch, work, io.StringIO()) == ""


def test_no_bars_on_request(monkeypatch):
    monkeypatch.setenv("FOUNDPOSE_PROGRESS", "false")
    assert shown_by(monkeypatch, work, Terminal()) == ""
    assert shown_by(monkeypatch, lambda: say("1/4 onboarding"), Terminal()) == "1/4 onboarding\n"


def test_there_is_one_place_for_bars_and_for_standard_error():
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        if path.name != "progress.py":
            assert "tqdm" not in text, path
            # The command itself has no Hydra, and prints its errors alone.
            assert path.name == "cli.py" or "file=sys.stderr" not in text, path
        assert "basicConfig" not in text, path
    for path in (ROOT / "conf").rglob("*.yaml"):
        assert "enable_progress_bar: true" not in path.read_text(encoding="utf-8"), path


@pytest.mark.slow
def test_an_app_writes_results_to_standard_output_and_warnings_to_standard_error(tmp_path):
    code = (
        "import logging, os, warnings, hydra\n"
        "from foundpose.config import clear_errors\n"
        f"@hydra.main(version_base='1.3', config_path={str(ROOT / 'conf')!r}, config_name='view')\n"
        "def main(cfg):\n"
        "    with clear_errors():\n"
        "        logging.getLogger('x').info('a step')\n"
        "        warnings.warn('a warning')\n"
        "        print('a result', os.environ['FOUNDPOSE_PROGRESS'])\n"
        "main()\n"
    )
    (tmp_path / "app.py").write_text(code)
    command = [sys.executable, "app.py", "-m", "progress=false", "frames=1,2", "hydra.sweep.dir=out"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ran.stdout == "a result false\n" * 2, ran.stderr
    assert ran.stderr.count("INFO: a step\nwarning: a warning\n") == 2

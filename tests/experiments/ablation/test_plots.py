from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from ablation import RunRecord, plot_sweep
from ablation.plots import _grows_by_factors
from tests.experiments.ablation.runs import sweep_run


def _runs() -> list[RunRecord]:
    runs = [
        sweep_run(
            {"words": words, "extractor": name, "seed": seed, "layer": words // 512},
            {"AR": level + words / 1e5 + seed / 100, "time_per_image": 1.0, "memory.total": words * 2**20},
        )
        for name, level in (("sift", 0.2), ("dinov2", 0.5))
        for words in (4096, 1024, 2048)
        for seed in (0, 1)
    ]
    runs.append(sweep_run({"words": 9999, "extractor": "sift"}, {}, status="failed"))
    runs.append(sweep_run({"words": 9999, "extractor": "sift"}, {"AR": 0.99}, label="random weights"))
    return runs


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that were saved."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(self: Figure, *args: Any, **kwargs: Any) -> None:
        figures.append(self)
        save(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def test_both_files_are_written(tmp_path: Path) -> None:
    files = plot_sweep(
        _runs(), "words", ["AR", "time_per_image", "memory.total"], tmp_path / "a" / "words.num", "extractor"
    )
    assert [file.name for file in files] == ["words.num.png", "words.num.pdf"]
    assert sorted(file.name for file in (tmp_path / "a").iterdir()) == ["words.num.pdf", "words.num.png"]
    pixels = np.asarray(Image.open(files[0]).convert("RGB")).reshape(-1, 3).astype(int)
    assert (np.ptp(pixels, axis=1) > 60).mean() > 0.001  # coloured lines, not a blank sheet
    assert files[1].read_bytes().startswith(b"%PDF")


def test_the_same_runs_give_the_same_files(tmp_path: Path) -> None:
    first = plot_sweep(_runs(), "words", ["AR"], tmp_path / "first")
    second = plot_sweep(_runs(), "words", ["AR"], tmp_path / "second")
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]


def test_lines_run_through_the_means_of_the_runs_that_count(tmp_path: Path, drawn: list[Figure]) -> None:
    assert plot_sweep(_runs(), "words", ["AR", "memory.total"], tmp_path / "w.png", "extractor") == [
        tmp_path / "w.png"
    ]
    recall, memory = drawn[0].axes
    lines = {line.get_label(): line for line in recall.lines if not str(line.get_label()).startswith("_")}
    assert list(lines) == ["dinov2", "sift"]
    assert list(lines["sift"].get_xdata()) == [1024, 2048, 4096]
    expected = [20.5 + words / 1e3 for words in (1024, 2048, 4096)]
    np.testing.assert_allclose(np.asarray(lines["sift"].get_ydata(), dtype=float), expected)
    np.testing.assert_allclose(np.asarray(memory.lines[0].get_ydata(), dtype=float), [1024, 2048, 4096])
    assert (recall.get_xlabel(), recall.get_ylabel(), memory.get_ylabel()) == (
        "words",
        "AR (%)",
        "memory.total (MiB)",
    )
    assert recall.get_xscale() == "log"
    bottom, top = memory.get_ylim()
    assert bottom == 0
    assert top > 4096
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["dinov2", "sift"]


def test_names_stand_side_by_side(tmp_path: Path, drawn: list[Figure]) -> None:
    plot_sweep(_runs(), "extractor", ["AR"], tmp_path / "e.png")
    (panel,) = drawn[0].axes
    assert [label.get_text() for label in panel.get_xticklabels()] == ["dinov2", "sift"]
    assert not drawn[0].legends


def test_lists_are_settings_too(tmp_path: Path, drawn: list[Figure]) -> None:
    plot_sweep(
        [sweep_run({"grid": [1, n]}, {"AR": 0.1 * n}) for n in (2, 1)], "grid", ["AR"], tmp_path / "g.png"
    )
    assert [label.get_text() for label in drawn[0].axes[0].get_xticklabels()] == ["[1, 1]", "[1, 2]"]


def test_one_line_per_dataset(tmp_path: Path, drawn: list[Figure]) -> None:
    runs = [sweep_run({"h": h}, {"AR": 0.1}, dataset=name) for h in (1, 5) for name in ("lmo", "hb")]
    plot_sweep(runs, "h", ["AR"], tmp_path / "h.png", series="dataset")
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["hb", "lmo"]


@pytest.mark.parametrize(
    ("values", "grows"),
    [
        ([128, 256, 512, 1024], True),
        ([400, 800, 1600], True),
        ([0.1, 0.3, 1, 3, 10], True),
        (list(range(24)), False),
        (list(range(1, 24)), False),
        ([200, 400, 600], False),
        ([1, 100], False),
    ],
)
def test_axes_follow_the_steps(values: list[float], grows: bool) -> None:
    assert _grows_by_factors(values) is grows


def test_nothing_to_plot_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'word' and AR; the settings"):
        plot_sweep(_runs(), "word", ["AR"], tmp_path / "a")
    with pytest.raises(ValueError, match="AR_VSD"):
        plot_sweep(_runs(), "words", ["AR", "AR_VSD"], tmp_path / "a")
    with pytest.raises(ValueError, match="a figure"):
        plot_sweep(_runs(), "words", [], tmp_path / "a")
    assert list(tmp_path.iterdir()) == []

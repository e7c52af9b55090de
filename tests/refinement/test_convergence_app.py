import json

import pytest
from PIL import Image

from tests.experiments.test_apps import SMALL, run_app


def test_convergence_app(tiny_bop, representations, monkeypatch, tmp_path, capsys):
    """Oracle codes on a tiny dataset: refinement finds perturbed poses again; table and plot are written."""
    run_app(
        monkeypatch,
        "convergence",
        *SMALL,
        "experiment=oracle",
        "data=bop",
        f"data.root={tiny_bop}",
        f"representations={representations}",
        f"hydra.run.dir={tmp_path / 'run'}",
        "max_images=2",
        "max_degrees=6",
        "perturbations=2",
    )
    facts = json.loads((tmp_path / "run" / "results.json").read_text())
    assert facts["instances"] >= 2
    assert facts["degrees"] == [3.0, 6.0]
    before, after = facts["table"]["perturbed"], facts["table"]["perturbed, refined"]
    assert before["median_rotation_degrees"] == pytest.approx(3.0, abs=0.1)
    assert after["median_rotation_degrees"] < 1.5
    assert all(0 <= share <= 1 for share in facts["basin"])
    assert Image.open(tmp_path / "run" / "basin.png").size[0] > 300
    assert "perturbed, refined" in capsys.readouterr().out


def test_convergence_needs_a_refiner(tiny_bop, monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        run_app(
            monkeypatch,
            "convergence",
            *SMALL,
            "extractor=dense_sift",
            "~refiner",
            "data=bop",
            f"data.root={tiny_bop}",
            f"hydra.run.dir={tmp_path / 'run'}",
        )
    assert stop.value.code == 2
    assert "set refiner=featuremetric" in capsys.readouterr().err

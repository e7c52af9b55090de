import json
import runpy
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from foundpose.config import build_method
from foundpose.features import ResidualAdapter
from tests.bop_dataset import write_ply

ROOT = Path(__file__).resolve().parents[2]
TINY = [
    "crop.size=210",
    "viewpoints.count=24",
    "words.num_words=32",
    "projection.num_components=32",
    "retrieval.num_templates=2",
    "pnp.iterations=50",
    "renderer.supersampling=1",
    "scenes=3",
    "meshes=1",
    "validation=1",
    "pairs.crops_per_mesh=4",
    "batch_size=4",
    "trainer.enable_progress_bar=false",
    "adapter.hidden=16",
]


def run_app(monkeypatch, folder, *overrides):
    arguments = [
        *TINY,
        f"hydra.run.dir={folder / 'run'}",
        f"representations={folder / 'objects'}",
        *overrides,
    ]
    monkeypatch.setattr(sys, "argv", ["train_adapter.py", *arguments])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    runpy.run_path(str(ROOT / "experiments" / "train_adapter.py"), run_name="__main__")
    return json.loads((folder / "run" / "results.json").read_text())


def test_train_resume_and_refuse(monkeypatch, tmp_path, capsys, bodies):
    write_ply(tmp_path / "cup.ply", bodies[0])
    cup = f"held_out={tmp_path / 'cup.ply'}"
    facts = run_app(monkeypatch, tmp_path, cup, "trainer.max_epochs=1")
    assert set(facts["results"]) == {"retrieved", "nearest"}
    for rows in facts["results"].values():
        assert rows["before"]["scenes"] == rows["after"]["scenes"] == 3
        assert rows["change"]["right"] == pytest.approx(rows["after"]["right"] - rows["before"]["right"])
    assert facts["settings"]["scenes"] == 3
    run = tmp_path / "run"
    adapter = ResidualAdapter.load(run / "adapter.safetensors")
    assert adapter.hidden == 16
    assert adapter.outer.weight.abs().max() > 0
    assert (run / "checkpoints" / "last.ckpt").is_file()
    out = capsys.readouterr().out
    assert "median rotation" in out
    assert str(run / "adapter.safetensors") in out
    # The object was onboarded without and with the adapter, under two names.
    assert len(list((tmp_path / "objects").iterdir())) == 2

    # One more epoch goes on where the first one ended; what was measured before is not measured again.
    before = (run / "before.safetensors").stat().st_mtime_ns
    pairs = {path: path.stat().st_mtime_ns for path in (run / "pairs").iterdir()}
    assert len(pairs) == 2
    again = run_app(monkeypatch, tmp_path, cup, "trainer.max_epochs=2")
    assert (run / "before.safetensors").stat().st_mtime_ns == before
    assert {path: path.stat().st_mtime_ns for path in (run / "pairs").iterdir()} == pairs
    assert again["results"]["nearest"]["before"] == facts["results"]["nearest"]["before"]
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["epoch"] == 1
    assert checkpoint["global_step"] == 4
    assert ResidualAdapter.load(run / "adapter.safetensors").checksum() != adapter.checksum()

    capsys.readouterr()
    for overrides, message in (
        ((cup, "scenes=4"), "other settings"),
        (("held_out_seed=1000",), "among those trained on"),
        ((cup, "meshes=many"), "list of mesh files or a number"),
    ):
        with pytest.raises(SystemExit, match="2"):
            run_app(monkeypatch, tmp_path, *overrides)
        assert message in capsys.readouterr().err

    # The adapter serves every app as an extractor.
    path = run / "adapter.safetensors"
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose(
            "demo",
            overrides=[
                "extractor=adapted_dense_sift",
                f"extractor.weights={path}",
                f"representations={tmp_path}",
            ],
        )
    method = build_method(cfg)
    assert (
        method.pipeline.extractor.adapter.checksum()
        == ResidualAdapter.load(run / "adapter.safetensors").checksum()
    )
    assert method.onboarder.bow.sigma == 0.3

import inspect
import json
import math
import runpy
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

import foundpose.training
from foundpose.config import build_method
from foundpose.features import AdaptedExtractor, ResidualAdapter
from foundpose.optimization import BarronLoss, LeastSquares
from foundpose.pnp import LevenbergMarquardtPnp, RansacPnp
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


def load(*overrides):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("train_adapter", overrides=list(overrides))


def new_training(*overrides):
    return instantiate(load(*overrides).training, adapter=ResidualAdapter(256, 16))


def app():
    return runpy.run_path(str(ROOT / "experiments" / "train_adapter.py"), run_name="app")


@pytest.mark.parametrize("option", sorted(path.stem for path in (ROOT / "conf" / "loss").glob("*.yaml")))
def test_every_loss_is_a_choice(option):
    cfg = load(f"loss={option}")
    constructor = get_class(cfg.loss._target_)
    parameters = list(inspect.signature(constructor).parameters)
    assert parameters == [key for key in cfg.loss if key != "_target_"]
    training = new_training(f"loss={option}")
    assert type(training.loss) is constructor
    for name in parameters:
        assert getattr(training.loss, name) == cfg.loss[name]
    assert training.error_scale == cfg.error_scale > 0
    assert new_training(f"loss={option}", "error_scale=0.7").error_scale == 0.7


def test_pnp_robust_loss_and_temperature_are_choices():
    training = new_training()
    assert type(training.pnp) is LevenbergMarquardtPnp
    assert type(training.pnp.loss) is LeastSquares
    assert type(new_training("robust_loss=barron").pnp.loss) is BarronLoss
    training = new_training("training.pnp=${pnp}", "pnp.iterations=77", "robust_loss=barron")
    assert type(training.pnp) is RansacPnp
    assert len(training.pnp.draws) == 77
    assert type(training.pnp.polish.loss) is BarronLoss
    # Each extractor has the temperature that suits its descriptors.
    for option, temperature in (("dense_sift", 0.1), ("dinov2", 5.0)):
        assert float(new_training(f"extractor={option}").matcher.temperature) == pytest.approx(temperature)


def test_symmetries_of_files(tmp_path):
    read = app()["wanted_symmetries"]
    info = tmp_path / "models_info.json"
    info.write_text(
        json.dumps({"1": {}, "7": {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}})
    )
    files = ["a/obj_000007.ply", "a/obj_000001.ply"]
    cfg = OmegaConf.create({"models_info": str(info), "meshes": files, "held_out": files[0], "validation": 2})
    assert read(cfg, "meshes").axis_valid.tolist() == [[True], [False]]
    assert read(cfg, "held_out").axis_valid.tolist() == [[True]]
    # Procedural objects have none, nor has anything without the file.
    assert read(cfg, "validation") is None
    cfg.held_out = None
    assert read(cfg, "held_out") is None
    for name in ("cup.ply", "obj_000003.ply"):
        cfg.held_out = name
        with pytest.raises(ValueError, match=rf"objects \[1, 7\]; which of them is {name}"):
            read(cfg, "held_out")
    cfg.models_info = None
    assert read(cfg, "meshes") is None


def test_the_extractor_written_is_complete(tmp_path):
    """For any extractor, not only DenseSIFT."""
    names = app()
    small = "{hidden_size: 24, num_attention_heads: 2, num_hidden_layers: 1}"
    random = ["extractor=dinov2", "extractor.weights=random", "extractor.seed=0"]
    cfg = load(*random, f"extractor.config={small}", "descriptors.sigma=7.0")
    module = instantiate(cfg.training, adapter=ResidualAdapter(24, 8))
    with torch.no_grad():
        module.adapter.outer.weight.fill_(0.1)
        module.matcher.log_temperature += 1.0
    module.adapter.save(tmp_path / "adapter.safetensors")
    trained = names["with_adapter"](cfg, module, tmp_path / "adapter.safetensors")
    names["write_extractor"](trained, tmp_path / "extractor" / "adapted.yaml")
    # What --config-dir does.
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        found = compose("estimate", overrides=[f"hydra.searchpath=[{tmp_path}]", "extractor=adapted"])
    extractor = instantiate(found.extractor)
    assert isinstance(extractor, AdaptedExtractor)
    inner = instantiate(cfg.extractor)
    assert extractor.fingerprint() == AdaptedExtractor(inner, module.adapter).fingerprint()
    assert found.descriptors == {**cfg.descriptors, "temperature": found.descriptors.temperature}
    assert found.bow.sigma == 7.0
    assert found.descriptors.temperature == pytest.approx(5.0 * math.e, rel=1e-4)


@pytest.mark.slow
def test_train_resume_and_refuse(monkeypatch, tmp_path, capsys, bodies):
    measured = []

    def spy(*args, symmetries=None, **settings):
        measured.append(symmetries)
        return evaluate_scenes(*args, symmetries=symmetries, **settings)

    evaluate_scenes = foundpose.training.evaluate_scenes
    monkeypatch.setattr(foundpose.training, "evaluate_scenes", spy)
    write_ply(tmp_path / "obj_000004.ply", bodies[0])
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    (tmp_path / "models_info.json").write_text(json.dumps({"4": {"symmetries_discrete": [half_turn]}}))
    info = f"models_info={tmp_path / 'models_info.json'}"
    cup = f"held_out={tmp_path / 'obj_000004.ply'}"
    facts = run_app(monkeypatch, tmp_path, info, cup, "trainer.max_epochs=1")
    # Before and after.
    assert [s.valid.tolist() for s in measured] == [[[True, True]]] * 2
    assert set(facts["results"]) == {"retrieved", "nearest"}
    for rows in facts["results"].values():
        assert rows["before"]["poses"] == rows["after"]["poses"] == 3
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
    assert len(list((tmp_path / "objects").glob("*.safetensors"))) == 2

    # One more epoch goes on where the first one ended; what was measured before is not measured again.
    before = (run / "before.safetensors").stat().st_mtime_ns
    pairs = {path: path.stat().st_mtime_ns for path in (run / "artefacts").glob("pairs/*.safetensors")}
    assert len(pairs) == 2
    again = run_app(monkeypatch, tmp_path, info, cup, "trainer.max_epochs=2")
    assert (run / "before.safetensors").stat().st_mtime_ns == before
    assert {
        path: path.stat().st_mtime_ns for path in (run / "artefacts").glob("pairs/*.safetensors")
    } == pairs
    assert again["results"]["nearest"]["before"] == facts["results"]["nearest"]["before"]
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["epoch"] == 1
    assert checkpoint["global_step"] == 4
    assert ResidualAdapter.load(run / "adapter.safetensors").checksum() != adapter.checksum()
    assert len(measured) == 3
    # Nothing is left to do: neither trained nor measured again, and the times stay on record.
    done = run_app(monkeypatch, tmp_path, info, cup, "trainer.max_epochs=2")
    assert len(measured) == 3
    assert done["results"] == again["results"]
    assert set(done["seconds"]) == {"before", "training", "after"}
    for name, value in done["seconds"].items():
        assert value > again["seconds"][name] >= facts["seconds"][name] > 0.1

    capsys.readouterr()
    for overrides, message in (
        ((info, cup, "scenes=4"), "other settings"),
        (("held_out_seed=1000",), "among those trained on"),
        ((info, cup, "meshes=many"), "list of mesh files or a number"),
    ):
        with pytest.raises(SystemExit, match="2"):
            run_app(monkeypatch, tmp_path, *overrides)
        assert message in capsys.readouterr().err

    # The adapter serves every app as an extractor: by the option written beside it.
    capsys.readouterr()
    arguments = ["demo.py", "--config-dir", str(run), "extractor=adapted", "--cfg", "job"]
    monkeypatch.setattr(sys, "argv", arguments)
    runpy.run_path(str(ROOT / "experiments" / "demo.py"), run_name="__main__")
    written = OmegaConf.create(capsys.readouterr().out)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("demo", overrides=[f"hydra.searchpath=[{run}]", "extractor=adapted"])
    path = run / "adapter.safetensors"
    assert written.extractor == cfg.extractor
    assert written.extractor.weights == str(path.resolve())
    assert written.descriptors.sigma == 0.3
    cfg.representations = str(tmp_path)
    extractor = build_method(cfg).pipeline.extractor
    assert extractor.adapter.checksum() == ResidualAdapter.load(path).checksum()

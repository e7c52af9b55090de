"""MegaPose's network in the training of learned refiners."""

import json
import runpy
import sys

import pytest
import pytorch_lightning as pl
import torch
from hydra.utils import instantiate

from foundpose.config import load_config
from foundpose.refinement import MegaPoseNetwork, MegaPoseRefiner
from foundpose.rendering import RaycastRenderer
from foundpose.training import Perturbation, RefinerPictures, RefinerTraining
from tests.bop_dataset import write_ply
from tests.training.test_refiner_training import ROOT, SETTINGS, data_module, fit


@pytest.mark.slow
def test_training_lowers_the_loss(bodies, tmp_path):
    pl.seed_everything(0, verbose=False)
    renderer = RaycastRenderer(1, 1.0)
    # Shifts are learnt within seconds, rotations within an hour.
    shifts = Perturbation(rotation=5.0, lateral=0.06, depth=0.02)
    pictures = RefinerPictures(bodies, SETTINGS, shifts, renderer, seed=3, surface_points=64)
    network = MegaPoseNetwork("pose", 4, width=8, seed=0)
    training = RefinerTraining(
        MegaPoseRefiner(network, renderer, 1, resolution=(48, 64)), 1, learning_rate=3e-3
    )
    batch = pictures.__getitems__(range(24))
    with torch.no_grad():
        before = training.batch_loss(batch)
    fit(tmp_path, training, data_module(bodies, pictures, passes=6), 6)
    with torch.no_grad():
        after = training.train().batch_loss(batch)
    assert before.valid.all()
    assert float(after.loss) < 0.95 * float(before.loss)


def test_app_trains_it_and_goes_on_from_its_weights(monkeypatch, tmp_path, capsys, bodies):
    write_ply(tmp_path / "cup.ply", bodies[0])
    small = [
        "refiner=megapose",
        "megapose.width=4",
        "refiner.resolution=[48,64]",
        "refiner.renderer.supersampling=1",
        "refiner.iterations=1",
        "training.iterations=1",
        f"held_out={tmp_path / 'cup.ply'}",
        "poses=4",
        "meshes=1",
        "validation=0",
        "data_module.pictures.pictures_per_mesh=4",
        "data_module.pictures.size=64",
        "data_module.batch_size=4",
        "data_module.surface_points=32",
        "trainer.enable_progress_bar=false",
        "trainer.max_epochs=1",
    ]
    path = tmp_path / "first" / "refiner.safetensors"
    for run, weights in (
        ("first", ["megapose.weights=random", "megapose.seed=0"]),
        ("second", [f"refiner.network.weights={path}"]),
    ):
        arguments = ["train_refiner.py", *small, *weights, f"hydra.run.dir={tmp_path / run}"]
        monkeypatch.setattr(sys, "argv", arguments)
        runpy.run_path(str(ROOT / "experiments" / "train_refiner.py"), run_name="__main__")
        assert f"refiner=megapose refiner.network.weights={tmp_path / run}" in capsys.readouterr().out
        assert json.loads((tmp_path / run / "results.json").read_text())["results"]["after"]["poses"] == 4
    used = load_config("demo", ["refiner=megapose", "megapose.width=4", f"refiner.network.weights={path}"])
    first = instantiate(used.refiner).network
    start = MegaPoseNetwork("pose", 4, 4, seed=0)
    second = MegaPoseNetwork("pose", 4, 4, tmp_path / "second" / "refiner.safetensors")
    counted = [int(net.backbone.bn1.num_batches_tracked) for net in (start, first, second)]
    assert counted == [0, 1, 2]
    assert not torch.equal(first.pose_fc.weight, second.pose_fc.weight)

import copy
import json
import logging
import math
import runpy
import sys
from pathlib import Path

import pytest
import pytorch_lightning as pl
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from foundpose.geometry import make_transform, rotation_angle, transform_points
from foundpose.refinement import RenderAndCompareRefiner, UpdateNetwork, apply_update, update_between
from foundpose.rendering import RaycastRenderer
from foundpose.synthetic import LightVariation
from foundpose.training import (
    EpochShuffle,
    Perturbation,
    PictureSettings,
    PoseErrors,
    RefinerDataModule,
    RefinerPictures,
    RefinerTraining,
    compare,
    disentangled_error,
    evaluate_refiner,
    summarize,
)
from tests.bop_dataset import write_ply

logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
ROOT = Path(__file__).resolve().parents[2]
SETTINGS = PictureSettings(pictures_per_mesh=6, size=96, light=LightVariation())


@pytest.fixture(scope="module")
def pictures(bodies):
    return RefinerPictures(bodies, SETTINGS, Perturbation(), RaycastRenderer(1), seed=3, surface_points=64)


def new_training(iterations=1, **changes):
    network = UpdateNetwork(width=8, grid=8, reach=2, hidden=32)
    refiner = RenderAndCompareRefiner(network, RaycastRenderer(1), iterations=2, size=32)
    return RefinerTraining(refiner, iterations, **changes)


def data_module(bodies, pictures, **changes):
    data = RefinerDataModule(
        bodies, [], RaycastRenderer(1), SETTINGS, Perturbation(), **({"batch_size": 6, "seed": 3} | changes)
    )
    data.training = pictures
    return data


def fit(folder, training, data, epochs, checkpoint=None, callbacks=None):
    trainer = pl.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        gradient_clip_val=1.0,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=callbacks is not None,
        callbacks=callbacks,
        default_root_dir=folder,
    )
    trainer.fit(training, datamodule=data, ckpt_path=checkpoint)


def test_perturbations_have_the_given_size():
    T = make_transform(torch.eye(3).expand(2000, 3, 3), torch.tensor([10.0, -20.0, 500.0]).expand(2000, 3))
    centre = torch.tensor([3.0, 5.0, -7.0]).expand(2000, 3)
    moved = Perturbation(15.0, 0.02, 0.05)(T, centre, range(2000))
    before, after = (transform_points(A, centre[:, None])[:, 0] for A in (T, moved))
    ray = after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:]
    torch.testing.assert_close(ray.std(0), torch.tensor([0.02, 0.02]), rtol=0.06, atol=0)
    torch.testing.assert_close(
        (after[:, 2] / before[:, 2]).log().std(), torch.tensor(0.05), rtol=0.06, atol=0
    )
    # The length of a normal vector in three dimensions: mean σ √(8 / π).
    angle = torch.rad2deg(rotation_angle(moved[:, :3, :3], T[:, :3, :3]))
    assert float(angle.mean()) == pytest.approx(15 * math.sqrt(8 / math.pi), rel=0.03)
    # Each draw is its seed's.
    assert torch.equal(Perturbation(15.0, 0.02, 0.05)(T[:1], centre[:1], [77])[0], moved[77])
    same = Perturbation(0.0, 0.0, 0.0)(T, centre, range(2000))
    torch.testing.assert_close(same, T, rtol=0, atol=1e-3)
    with pytest.raises(ValueError, match=r"got -1\.0, 0\.02 and 0\.05"):
        Perturbation(rotation=-1.0)


def test_pictures_show_the_objects_at_the_true_poses(pictures, bodies):
    assert len(pictures) == 12
    batch = pictures.__getitems__([2, 9])
    assert batch.pictured.mesh_index.tolist() == [0, 1]
    renderer = RaycastRenderer(1)
    dark = PictureSettings(pictures_per_mesh=1, size=96, occlusion=False)
    for mesh in bodies:
        plain = RefinerPictures([mesh], dark, Perturbation(), renderer, seed=1)[0]
        render = renderer(mesh, plain.T_true, plain.pictured.K, (96, 96))
        inside = render.mask
        gray, shown = (x.mean(1)[inside] for x in (plain.pictured.images, render.rgb))
        assert torch.corrcoef(torch.stack([gray, shown]))[0, 1] > 0.8
    # Passing the end brings the same pictures and truths with other perturbations.
    later = pictures.__getitems__([14, 21])
    assert torch.equal(later.pictured.images, batch.pictured.images)
    assert torch.equal(later.T_true, batch.T_true)
    assert not torch.allclose(later.T_start, batch.T_start, atol=1.0)
    assert torch.equal(pictures[9].T_start[0], batch.T_start[1])


def test_order_depends_on_seed_and_epoch():
    sampler = EpochShuffle(10, 0, passes=2)
    first = list(sampler)
    assert len(first) == len(sampler) == 20
    assert sorted(first) == list(range(20))
    sampler.set_epoch(1)
    assert sorted(sampler) == list(range(20, 40))
    assert [k % 10 for k in sampler] != [k % 10 for k in first]
    assert list(EpochShuffle(10, 0, passes=2)) == first != list(EpochShuffle(10, 1, passes=2))


def test_disentangled_error_by_hand(pictures):
    batch = pictures.__getitems__([0, 7])
    refiner = new_training().refiner
    views = refiner.look(batch.T_start, batch.pictured)
    truth = views.T_view_from_camera @ batch.T_true
    update = update_between(views.T_view_from_model, truth, views.K, views.centre)
    common = (batch.T_true, batch.surface, batch.diameter, torch.tensor([True, True]))
    exact = disentangled_error(views, update, *common)
    torch.testing.assert_close(exact, torch.zeros(2, 3), rtol=0, atol=1e-4)
    # A wrong depth shows in the second part alone, as every point's shift along the ray.
    wrong = update.clone()
    wrong[:, 2] *= 1.1
    parts = disentangled_error(views, wrong, *common)
    centre = transform_points(truth, views.centre[:, None])[:, 0]
    torch.testing.assert_close(parts[:, 1], 0.1 * centre.abs().sum(1) / batch.diameter, rtol=1e-3, atol=1e-5)
    assert parts[:, [0, 2]].abs().max() < 1e-4
    # A wrong rotation shows in the third alone, and turns about the centre.
    wrong = update.clone()
    wrong[:, 3:] = torch.tensor([1.0, 0, 0, 0, 1, 0])
    parts = disentangled_error(views, wrong, *common)
    assert parts[:, :2].abs().max() < 1e-4
    turned = apply_update(views.T_view_from_model, wrong, views.K, views.centre)
    torch.testing.assert_close(
        transform_points(turned, views.centre[:, None])[:, 0], centre, rtol=1e-4, atol=1e-2
    )
    gap = (transform_points(turned, batch.surface) - transform_points(truth, batch.surface)).abs().sum(-1)
    torch.testing.assert_close(parts[:, 2], gap.mean(1) / batch.diameter, rtol=1e-3, atol=1e-5)
    none = disentangled_error(views, wrong, *common[:-1], torch.tensor([True, False]))
    assert (none[1] == 0).all()


def test_loss_counts_what_can_be_rendered_and_reaches_all_parameters(pictures):
    training = new_training(iterations=2)
    with torch.no_grad():
        training.refiner.network.output.weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    batch = pictures.__getitems__(range(4))
    bad = batch._replace(T_start=batch.T_start.clone())
    bad.T_start[2, 2, 3] = -500.0
    result = training.batch_loss(bad)
    assert result.valid.tolist() == [True, True, False, True]
    rest = training.batch_loss(pictures.__getitems__([0, 1, 3]))
    torch.testing.assert_close(result.loss, rest.loss, rtol=1e-3, atol=1e-5)
    result.loss.backward()
    for name, p in training.named_parameters():
        assert torch.isfinite(p.grad).all(), name
        assert p.grad.abs().max() > 0, name
    nothing = training.batch_loss(batch._replace(T_start=torch.full_like(batch.T_start, torch.nan)))
    assert nothing.loss == 0


@pytest.mark.slow
def test_training_lowers_the_loss(bodies, pictures, tmp_path):
    pl.seed_everything(0, verbose=False)
    training = new_training(learning_rate=3e-3)
    # Shifts are learnt within seconds, rotations within minutes.
    pictures = copy.copy(pictures)
    pictures.perturbation = Perturbation(rotation=5.0, lateral=0.06, depth=0.02)
    keys = range(48)
    with torch.no_grad():
        before = training.batch_loss(pictures.__getitems__(keys))
    fit(tmp_path, training, data_module(bodies, pictures, passes=6), 6)
    with torch.no_grad():
        after = training.batch_loss(pictures.__getitems__(keys))
    assert after.loss < 0.85 * before.loss
    assert after.after.mean() < 0.9 * before.before.mean()
    assert torch.allclose(before.after, before.before, atol=1e-4)


def test_resumed_training_ends_where_an_uninterrupted_one_does(bodies, pictures, tmp_path):
    class Stop(pl.Callback):
        def on_train_epoch_end(self, trainer, module):
            trainer.should_stop = True

    def run(folder, checkpoint=None, *more):
        pl.seed_everything(0, verbose=False)
        training = new_training()
        saver = pl.callbacks.ModelCheckpoint(dirpath=folder, save_last=True)
        fit(tmp_path, training, data_module(bodies, pictures), 2, checkpoint, [saver, *more])
        return training, saver.last_model_path

    half, path = run(tmp_path / "half", None, Stop())
    resumed, _ = run(tmp_path / "resumed", path)
    whole, _ = run(tmp_path / "whole")
    for (name, p), q in zip(whole.named_parameters(), resumed.parameters(), strict=True):
        assert torch.allclose(p, q, rtol=1e-4, atol=1e-6), name
    assert not torch.allclose(half.refiner.network.output.bias, whole.refiner.network.output.bias)


def test_errors_and_their_summary(pictures):
    before, after = evaluate_refiner(new_training().refiner, pictures, batch_size=5)
    # An untrained network changes nothing.
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-2)
    batch = pictures.__getitems__(range(12))
    angle = torch.rad2deg(rotation_angle(batch.T_start[:, :3, :3], batch.T_true[:, :3, :3]))
    torch.testing.assert_close(before.rotation, angle)
    half = PoseErrors(*(x / 2 if x.is_floating_point() else x for x in before))
    change = compare(before, half)
    assert change["rotation_improved"] == change["matching_improved"] == 1.0
    assert change["mean_matching"] == pytest.approx(-float(before.matching.mean()) / 2)
    summary = summarize(before)
    assert summary["poses"] == 12
    assert summary["found"] == 1.0
    assert summary["median_rotation"] == float(before.rotation.median())
    assert 0 < summary["median_rotation_standard_error"] < float(before.rotation.std())
    with pytest.raises(ValueError, match="12 and 3 poses"):
        compare(before, PoseErrors(*(x[:3] for x in half)))


def test_bad_settings(bodies):
    with pytest.raises(ValueError, match="learning_rate"):
        new_training(learning_rate=0.0)
    with pytest.raises(ValueError, match="pictures_per_mesh must be at least 1, got 0"):
        PictureSettings(pictures_per_mesh=0)
    for arguments, message in [(([],), "meshes is empty"), ((bodies, 0), "got 0 and 1")]:
        meshes, *batch_size = arguments
        with pytest.raises(ValueError, match=message):
            RefinerDataModule(meshes, [], RaycastRenderer(), SETTINGS, Perturbation(), *batch_size)


TINY = [
    "poses=4",
    "meshes=1",
    "validation=1",
    "data_module.pictures.pictures_per_mesh=4",
    "data_module.pictures.size=64",
    "data_module.batch_size=4",
    "data_module.surface_points=32",
    "refiner.network.width=8",
    "refiner.network.grid=8",
    "refiner.network.reach=2",
    "refiner.network.hidden=16",
    "refiner.size=32",
    "refiner.iterations=2",
    "trainer.enable_progress_bar=false",
    "trainer.check_val_every_n_epoch=1",
]


def run_app(monkeypatch, folder, *overrides):
    arguments = [*TINY, f"hydra.run.dir={folder / 'run'}", *overrides]
    monkeypatch.setattr(sys, "argv", ["train_refiner.py", *arguments])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    runpy.run_path(str(ROOT / "experiments" / "train_refiner.py"), run_name="__main__")
    return json.loads((folder / "run" / "results.json").read_text())


@pytest.mark.slow
def test_train_resume_and_refuse(monkeypatch, tmp_path, capsys, bodies):
    write_ply(tmp_path / "cup.ply", bodies[0])
    cup = f"held_out={tmp_path / 'cup.ply'}"
    facts = run_app(monkeypatch, tmp_path, cup, "trainer.max_epochs=1")
    results, run = facts["results"], tmp_path / "run"
    assert results["before"]["poses"] == results["after"]["poses"] == 4
    assert results["change"]["mean_matching"] == pytest.approx(
        results["after"]["mean_matching"] - results["before"]["mean_matching"], abs=1e-6
    )
    out = capsys.readouterr().out
    assert "improved" in out
    assert f"refiner.network.weights={run / 'refiner.safetensors'}" in out

    again = run_app(monkeypatch, tmp_path, cup, "trainer.max_epochs=2")
    assert again["results"]["before"] == results["before"]
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 2

    capsys.readouterr()
    for overrides, message in (
        ((cup, "poses=5"), "other settings"),
        (("held_out_seed=1000",), "among those trained on"),
        ((cup, "meshes=many"), "list of mesh files or a number"),
    ):
        with pytest.raises(SystemExit, match="2"):
            run_app(monkeypatch, tmp_path, *overrides)
        assert message in capsys.readouterr().err

    # The network serves every app's refiner, alone and after the featuremetric one.
    path = run / "refiner.safetensors"
    sizes = [x.removeprefix("refiner.") for x in TINY if x.startswith("refiner.")]
    for option, node in (("render_and_compare", "refiner"), ("chain", "refiners.render_and_compare")):
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            cfg = compose(
                "demo",
                overrides=[
                    f"refiner={option}",
                    *(f"{node}.{x}" for x in sizes),
                    f"{node}.network.weights={path}",
                ],
            )
        refiner = instantiate(cfg.refiner)
        learned = refiner if option == "render_and_compare" else refiner.refiners[1]
        assert learned.iterations == 2
        expected = checkpoint["state_dict"]["refiner.network.output.weight"]
        assert torch.equal(learned.network.output.weight, expected)
        assert expected.abs().max() > 0

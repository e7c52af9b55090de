import copy
import logging

import pytest
import pytorch_lightning as pl
import torch

from foundpose.features import ResidualAdapter
from foundpose.geometry import rotation_angle, stack_symmetries, symmetries_from_models_info
from foundpose.losses import GeodesicRotationLoss, PointMatchingLoss, ProjectionLoss
from foundpose.matching import SoftPatchMatcher
from foundpose.optimization import BarronLoss
from foundpose.pnp import LevenbergMarquardtPnp, RansacPnp
from foundpose.synthetic import LightVariation, procedural_mesh
from foundpose.training import (
    AdapterTraining,
    PairDataModule,
    PairLoss,
    PairSettings,
    PatchPairs,
    make_pairs,
)

logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)


def new_training(pnp="gauss_newton", alpha=1.0, scale=30.0, iterations=30, tolerance=1e-5, **settings):
    polish = LevenbergMarquardtPnp(BarronLoss(alpha, scale), max_iterations=iterations, tolerance=tolerance)
    return AdapterTraining(
        ResidualAdapter(256, 32),
        SoftPatchMatcher(0.15, learnable=True),
        polish if pnp == "gauss_newton" else RansacPnp(polish=polish),
        **settings,
    )


def trainer(folder, epochs, **settings):
    return pl.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        gradient_clip_val=1.0,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        **settings,
    )


def data_module(bodies, sift_onboarder, crop, settings, pairs):
    data = PairDataModule(bodies, [], sift_onboarder, crop, settings, batch_size=8, seed=3)
    data.training = pairs
    return data


@pytest.mark.parametrize("pnp", ["gauss_newton", "ransac"])
def test_poses_and_gradients(pairs, pnp):
    training = new_training(pnp, alpha=-2.0, scale=5.0)
    batch = pairs.__getitems__(range(12))
    poses = training(batch)
    assert poses.valid.float().mean() > 0.8
    angle = torch.rad2deg(
        rotation_angle(poses.T_crop_from_model[:, :3, :3], batch.T_crop_from_model[:, :3, :3])
    )
    assert angle[poses.valid].median() < 15
    # At the identity the first layer has no gradient, so a step is taken first.
    with torch.no_grad():
        training.adapter.outer.weight.normal_(0.0, 0.01, generator=torch.Generator().manual_seed(0))
    training.pair_loss(batch).loss.backward()
    for name, parameter in training.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_gradient_of_the_loss_agrees_with_finite_differences(pairs):
    training = new_training(iterations=300, tolerance=None).double()
    batch = pairs.__getitems__([3, 20])
    batch = batch._replace(
        **{name: x.double() for name, x in batch._asdict().items() if x is not None and x.is_floating_point()}
    )
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        training.adapter.outer.weight.normal_(0.0, 0.02, generator=generator)
    training.pair_loss(batch).loss.backward()
    parameters = list(training.parameters())
    direction = [torch.randn(p.shape, generator=generator, dtype=torch.float64) * 0.1 for p in parameters]
    slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, direction, strict=True))
    values, step = [], 1e-4
    for sign in (1, -1):
        moved = copy.deepcopy(training)
        with torch.no_grad():
            for p, d in zip(moved.parameters(), direction, strict=True):
                p += sign * step * d
            values.append(float(moved.pair_loss(batch).loss))
    assert slope == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4)


def test_pairs_do_not_see_their_neighbours(pairs):
    training = new_training()
    together = training.pair_loss(pairs.__getitems__([2, 17, 30]))
    for row, index in enumerate((2, 17, 30)):
        assert torch.allclose(
            training.pair_loss(pairs[index]).error[0], together.error[row], rtol=1e-3, atol=1e-5
        )


def test_hopeless_pairs_do_not_count(pairs):
    training = new_training()
    batch = pairs.__getitems__([2, 17])
    blind = batch._replace(query_valid=batch.query_valid & torch.tensor([[True], [False]]))
    result = training.pair_loss(blind)
    assert result.valid.tolist() == [True, False]
    assert torch.allclose(result.loss, training.pair_loss(pairs[2]).loss, rtol=1e-3)
    result.loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in training.parameters())
    # With no pair left the loss is a zero without effect.
    nothing = training.pair_loss(batch._replace(query_valid=torch.zeros_like(batch.query_valid)))
    assert nothing.loss == 0


@pytest.mark.parametrize("pnp", ["gauss_newton", "ransac"])
def test_pairs_whose_pose_is_not_determined_do_not_count(pairs, pnp):
    training = new_training(pnp)
    batch = pairs.__getitems__([2, 17])
    # All points of the first pair on one line: the object may turn about it.
    line = torch.tensor([1.0, 0.2, 0.1])
    points = batch.template_points.clone()
    points[0] = (points[0] @ line)[:, None] * line
    poses = training(batch._replace(template_points=points))
    assert poses.valid.tolist() == [False, True]


@pytest.mark.parametrize(
    ("loss", "scale"),
    [(PointMatchingLoss("l2"), 0.1), (ProjectionLoss(), 25.0), (GeodesicRotationLoss(), 0.3)],
)
def test_every_loss_trains_and_knows_symmetries(pairs, loss, scale):
    training = new_training("ransac", loss=loss, error_scale=scale)
    half_turn = {"symmetries_discrete": [[-1, 0, 0, 2, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
    # The first object has a symmetry, the second has none.
    symmetries = stack_symmetries([symmetries_from_models_info(entry) for entry in (half_turn, {})])
    known = PatchPairs(pairs.tensors, symmetries.to(dtype=torch.float32))
    rows = [1, 4, 20, 25]
    plain, batch = pairs.__getitems__(rows), known.__getitems__(rows)
    S = symmetries.transforms[0, 1].float()
    turned = plain._replace(T_crop_from_model=plain.T_crop_from_model @ S)
    with torch.no_grad():
        poses = training(plain)
        one, other, least = (training.pose_errors(poses, b) for b in (plain, turned, batch))
    assert poses.valid.all()
    assert torch.allclose(least[:2], torch.minimum(one, other)[:2], rtol=1e-4, atol=1e-5)
    assert torch.equal(least[2:], one[2:])
    with torch.no_grad():
        same = training.pose_errors(poses, batch._replace(T_crop_from_model=turned.T_crop_from_model))
    assert torch.allclose(same[:2], least[:2], rtol=1e-3, atol=1e-4)
    # The unit: what is far off in it has about the scale's size, and its gradient arrives.
    assert 0.01 * scale < float(one.median()) < 10 * scale
    training.pair_loss(batch).loss.backward()
    assert torch.isfinite(training.adapter.outer.weight.grad).all()
    assert training.adapter.outer.weight.grad.abs().max() > 0


def test_what_is_logged_is_of_the_valid_pairs():
    training = new_training()
    logged = {}
    training.log = lambda name, value, batch_size, **_: logged.update({name: (float(value), batch_size)})
    valid = torch.tensor([True, False, False, True, False, True])
    errors = torch.tensor([0.1, 0.0, 0.0, 0.3, 0.0, 0.2], requires_grad=True)
    training._log("val", PairLoss(torch.tensor(0.7), errors, valid))
    assert logged["val/median_error"] == (pytest.approx(0.2), 3)
    assert logged["val/loss"] == (pytest.approx(0.7), 3)
    assert logged["val/valid"] == (0.5, 6)
    logged.clear()
    training._log("val", PairLoss(torch.tensor(0.0), torch.zeros(2), torch.tensor([False, False])))
    assert logged == {"val/valid": (0.0, 2)}


@pytest.mark.slow
def test_training_improves_the_poses_of_unseen_objects(sift_onboarder, crop, tmp_path):
    """The claim of experiments/train_adapter.py, small: other meshes, other pictures, the true match never told."""
    settings = PairSettings(10, 2, max_degrees=40.0, light=LightVariation(), surface_points=128)
    meshes, unseen = (
        [procedural_mesh(seed, subdivisions=4) for seed in seeds] for seeds in ((11, 12, 13), (21, 22))
    )
    held_out = make_pairs(unseen, sift_onboarder, crop, settings, seed=100)
    batch = held_out.__getitems__(range(len(held_out)))
    pl.seed_everything(0, verbose=False)
    training = AdapterTraining(
        ResidualAdapter(256, 128),
        SoftPatchMatcher(0.1, learnable=True),
        LevenbergMarquardtPnp(max_iterations=30, tolerance=1e-4),
        error_scale=0.1,
    )
    ransac = RansacPnp()

    def errors(pnp):
        training.pnp = pnp
        with torch.no_grad():
            result = training.pair_loss(batch)
        return torch.where(result.valid, result.error, 1.0).clamp(max=1.0)

    polish = training.pnp
    before = errors(polish), errors(ransac)
    training.pnp = polish
    data = PairDataModule(meshes, [], sift_onboarder, crop, settings, batch_size=8)
    trainer(tmp_path, 8, enable_checkpointing=False).fit(training, datamodule=data)
    after = errors(polish), errors(ransac)
    # Three seeds of the training: 0.91 → 0.69 to 0.74 when every match counts, 0.22 → 0.19 to 0.21 with RANSAC.
    assert after[0].mean() < 0.9 * before[0].mean()
    assert after[1].mean() < 0.97 * before[1].mean()


def test_training_lowers_the_loss(bodies, sift_onboarder, crop, settings, pairs, tmp_path):
    pl.seed_everything(0, verbose=False)
    training = new_training()
    data = data_module(bodies, sift_onboarder, crop, settings, pairs)
    batch = pairs.__getitems__(range(len(pairs)))
    with torch.no_grad():
        before = training.pair_loss(batch)
    trainer(tmp_path, 8, enable_checkpointing=False).fit(training, datamodule=data)
    with torch.no_grad():
        after = training.pair_loss(batch)
    assert after.loss < 0.75 * before.loss
    assert after.error.median() < 0.85 * before.error.median()
    changed = {
        name: not torch.equal(p, q)
        for (name, p), q in zip(training.named_parameters(), new_training().parameters(), strict=True)
    }
    assert all(changed.values()), changed


def test_resumed_training_ends_where_an_uninterrupted_one_does(
    bodies, sift_onboarder, crop, settings, pairs, tmp_path
):
    def fit(epochs, checkpoint=None):
        pl.seed_everything(0, verbose=False)
        training = new_training()
        saver = pl.callbacks.ModelCheckpoint(dirpath=tmp_path / str(epochs), save_last=True)
        data = data_module(bodies, sift_onboarder, crop, settings, pairs)
        trainer(tmp_path, epochs, callbacks=[saver]).fit(training, datamodule=data, ckpt_path=checkpoint)
        return training, saver.last_model_path

    half, path = fit(1)
    resumed, _ = fit(2, path)
    whole, _ = fit(2)
    for (name, p), q, r in zip(
        whole.named_parameters(), resumed.parameters(), half.parameters(), strict=True
    ):
        assert torch.allclose(p, q, rtol=1e-5, atol=1e-8), name
        assert not torch.allclose(p, r, rtol=1e-5, atol=1e-8), name


def test_bad_settings(bodies, sift_onboarder, crop, settings):
    with pytest.raises(ValueError, match="learning_rate"):
        new_training(learning_rate=0.0)
    with pytest.raises(ValueError, match='reduction="none"'):
        new_training(loss=PointMatchingLoss(reduction="mean"))
    with pytest.raises(RuntimeError, match="call setup"):
        PairDataModule(bodies, [], sift_onboarder, crop, settings).train_dataloader()
    with pytest.raises(ValueError, match="meshes is empty"):
        PairDataModule([], [], sift_onboarder, crop, settings)
    with pytest.raises(ValueError, match="batch_size"):
        PairDataModule(bodies, [], sift_onboarder, crop, settings, batch_size=0)

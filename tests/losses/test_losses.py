import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from foundpose.geometry import (
    discretise,
    make_transform,
    no_symmetries,
    se3_exp,
    stack_symmetries,
    symmetries_from_models_info,
    transform_points,
)
from foundpose.losses import (
    GeodesicRotationLoss,
    PointMatchingLoss,
    ProjectionLoss,
    geodesic_rotation_error,
    point_matching_error,
    projection_error,
)

NORMS = ("l1", "l2", "squared")


def about(axis, degrees, origin=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.array(axis) * np.radians(degrees)).as_matrix()
    T[:3, 3] = np.array(origin) - T[:3, :3] @ origin
    return T.ravel().tolist()


# Groups, as symmetries of an object are; the centres lie off the model's origin.
CENTRE = (5.0, -3.0, 2.0)
AXIS = {"axis": [0, 0, 1], "offset": list(CENTRE)}
OBJECTS = {
    "none": {},
    "box": {"symmetries_discrete": [about(axis, 180, CENTRE) for axis in np.eye(3)]},
    "pyramid": {"symmetries_discrete": [about((0, 0, 1), k * 90, CENTRE) for k in (1, 2, 3)]},
    "cone": {"symmetries_continuous": [AXIS]},
    "cylinder": {
        "symmetries_discrete": [about((0.6, 0.8, 0), 180, CENTRE)],
        "symmetries_continuous": [AXIS],
    },
}
ALL = stack_symmetries([symmetries_from_models_info(entry) for entry in OBJECTS.values()])


def problem(batch, degrees=40.0, mm=25.0, seed=0, count=40):
    """Estimates, true poses, points, intrinsics; symmetries of the objects in turn."""
    rng = np.random.default_rng(seed)
    t = np.concatenate([rng.uniform(-150, 150, (batch, 2)), rng.uniform(500, 1000, (batch, 1))], axis=1)
    R = Rotation.random(batch, random_state=seed)
    error = Rotation.from_rotvec(rng.normal(size=(batch, 3)) * np.radians(degrees) / 2)
    T_true = make_transform(torch.from_numpy(R.as_matrix()), torch.from_numpy(t))
    T_est = make_transform(
        torch.from_numpy((error * R).as_matrix()), torch.from_numpy(t + rng.normal(size=(batch, 3)) * mm)
    )
    points = torch.from_numpy(rng.uniform(-1, 1, (batch, count, 3)) * [60, 40, 80] + [8, 0, -5])
    focal = rng.uniform(500, 900, (batch, 1, 1))
    K = torch.from_numpy(focal * np.diag([1, 1.02, 0]) + np.array([[0, 2.0, 320], [0, 0, 240], [0, 0, 1]]))
    return T_est, T_true, points, K, ALL.gather(torch.arange(batch) % len(OBJECTS))


def all_losses(T_est, T_true, points, K, symmetries=None, valid=None):
    """Every error (B,), by name."""
    losses = {"rotation": geodesic_rotation_error(T_est, T_true, symmetries, valid)}
    for norm in NORMS:
        losses[f"points {norm}"] = point_matching_error(
            T_est, T_true, points, symmetries, valid=valid, norm=norm
        )
        losses[f"pixels {norm}"] = projection_error(T_est, T_true, points, K, symmetries, valid, norm=norm)
    return losses


def numpy_norm(x, norm):
    return {"l1": np.abs(x).sum(-1), "l2": np.linalg.norm(x, axis=-1), "squared": (x**2).sum(-1)}[norm].mean(
        -1
    )


def test_errors_equal_their_definition():
    T_est, T_true, points, K, _ = problem(6)
    losses = all_losses(T_est, T_true, points, K)
    for b in range(6):
        P, Q, x, k = (value[b].numpy() for value in (T_est, T_true, points, K))
        a, c = x @ P[:3, :3].T + P[:3, 3], x @ Q[:3, :3].T + Q[:3, 3]
        u, v = a @ k.T / a[:, 2:], c @ k.T / c[:, 2:]
        for norm in NORMS:
            assert losses[f"points {norm}"][b].item() == pytest.approx(numpy_norm(a - c, norm), rel=1e-10)
            assert losses[f"pixels {norm}"][b].item() == pytest.approx(numpy_norm(u - v, norm), rel=1e-10)
        turn = Rotation.from_matrix(P[:3, :3]).inv() * Rotation.from_matrix(Q[:3, :3])
        assert losses["rotation"][b].item() == pytest.approx(turn.magnitude(), rel=1e-10)


def test_shared_points_diameter_and_reductions():
    T_est, T_true, points, K, symmetries = problem(5)
    shared = points[:1].expand(5, -1, -1)
    diameter = torch.linspace(100.0, 300.0, 5, dtype=torch.float64)
    for norm in NORMS:
        loss = PointMatchingLoss(norm=norm)
        plain = loss(T_est, T_true, shared, symmetries)
        assert torch.allclose(loss(T_est, T_true, points[0], symmetries), plain, rtol=1e-12)
        power = 2 if norm == "squared" else 1
        scaled = loss(T_est, T_true, points[0], symmetries, diameter)
        assert torch.allclose(scaled, plain / diameter**power, rtol=1e-12)
        pixels = ProjectionLoss(norm=norm)(T_est, T_true, points[0], K, symmetries)
        assert torch.allclose(pixels, projection_error(T_est, T_true, shared, K, symmetries, norm=norm))
    valid = torch.tensor([True, False, True, True, False])
    for make, inputs in (
        (PointMatchingLoss, (points, symmetries, diameter)),
        (ProjectionLoss, (points, K, symmetries)),
        (GeodesicRotationLoss, (symmetries,)),
    ):
        each = make()(T_est, T_true, *inputs, valid=valid)
        assert each.shape == (5,)
        assert (each[~valid] == 0).all()
        assert (each[valid] > 0).all()
        mean, total = (make(reduction=name)(T_est, T_true, *inputs, valid=valid) for name in ("mean", "sum"))
        assert torch.allclose(mean, each.sum() / 3)
        assert torch.allclose(total, each.sum())
        plain = make()(T_est, T_true, *inputs)
        assert torch.allclose(make(reduction="mean")(T_est, T_true, *inputs), plain.mean())
        assert "reduction='sum'" in repr(make(reduction="sum"))


@pytest.mark.parametrize("degrees", [4.0, 40.0, 150.0])
def test_errors_are_the_least_over_a_dense_set_of_symmetries(degrees):
    batch = 20
    T_est, T_true, points, K, symmetries = problem(batch, degrees, seed=int(degrees))
    S, exists = discretise(symmetries, 0.02)
    index = torch.arange(batch).repeat_interleave(S.shape[1])
    every = all_losses(T_est[index], T_true[index] @ S.flatten(0, 1), points[index], K[index])
    best = {
        name: error.view_as(exists).masked_fill(~exists, torch.inf).amin(dim=1)
        for name, error in every.items()
    }
    for name, error in all_losses(T_est, T_true, points, K, symmetries).items():
        # Never above any sampled symmetry, never below by more than the sampling costs.
        assert (error <= best[name] * (1 + (2e-3 if "l1" in name else 1e-9))).all(), name
        if degrees > 4:
            assert (error >= best[name] * (1 - 2e-3)).all(), name


def test_error_is_zero_under_every_symmetry():
    T_est, _, points, K, symmetries = problem(5)
    S, exists = discretise(symmetries, 1.5)
    index, k = exists.nonzero(as_tuple=True)
    T_est, T_true = T_est[index], T_est[index] @ S[index, k]
    for name, error in all_losses(T_est, T_true, points[index], K[index], symmetries.gather(index)).items():
        assert error.max() < 1e-5, name


@settings(max_examples=6, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    angle=st.floats(-7.0, 7.0),
    flip=st.integers(0, 3),
    degrees=st.floats(1.0, 170.0),
)
def test_equivalent_true_poses_give_the_same_losses(seed, angle, flip, degrees):
    T_est, T_true, points, K, symmetries = problem(5, degrees, seed=seed, count=15)
    step = torch.tensor([0, 0, 0, 0, 0, angle], dtype=torch.float64)
    centre = torch.tensor([*CENTRE], dtype=torch.float64)
    away = make_transform(torch.eye(3).double(), centre)
    turn = away @ se3_exp(step) @ make_transform(torch.eye(3).double(), -centre)
    some = [flip % int(n) for n in symmetries.valid.sum(1)]
    S = symmetries.transforms[torch.arange(5), some]
    S = torch.where(symmetries.axis_valid.any(1)[:, None, None], turn @ S, S)
    twice = torch.arange(5).repeat(2)
    T_true = torch.cat([T_true, T_true @ S])
    for name, error in all_losses(
        T_est[twice], T_true, points[twice], K[twice], symmetries.gather(twice)
    ).items():
        assert torch.allclose(error[:5], error[5:], rtol=1e-6, atol=1e-7), name


def twisted(T_est, T_true, origin):
    """Poses from twists (B, 6) about the object's centre, lengths and angles alike in size."""
    to, back = (make_transform(torch.eye(3).double().expand(len(T_est), 3, 3), s * origin) for s in (1, -1))
    unit = torch.tensor([50.0, 50, 50, 1, 1, 1], dtype=torch.float64)
    return lambda twist: to @ se3_exp(unit * twist) @ back @ T_est


@pytest.mark.parametrize("norm", NORMS)
def test_gradients_without_symmetries(norm):
    T_est, T_true, points, K, _ = problem(3, count=6)
    diameter = torch.tensor([100.0, 150, 200], dtype=torch.float64)
    inputs = tuple(x.requires_grad_() for x in (T_est, T_true, points, diameter))
    assert torch.autograd.gradcheck(
        lambda a, b, x, d: point_matching_error(a, b, x, diameter=d, norm=norm), inputs
    )
    inputs = (*inputs[:3], K.requires_grad_())
    assert torch.autograd.gradcheck(partial(projection_error, norm=norm), inputs, rtol=1e-3, atol=1e-4)
    assert torch.autograd.gradcheck(geodesic_rotation_error, inputs[:2])


@pytest.mark.parametrize("norm", ["l2", "squared"])
def test_gradients_under_symmetries(norm):
    T_est, T_true, points, K, symmetries = problem(5, count=12)
    pose = twisted(T_est, T_true, T_est[:, :3, 3])
    twist = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    check = partial(torch.autograd.gradcheck, eps=1e-5, atol=1e-5, rtol=1e-4, fast_mode=True)
    points.requires_grad_()
    assert check(
        lambda w, x: point_matching_error(pose(w), T_true, x, symmetries, norm=norm), (twist, points)
    )
    assert check(lambda w, x: projection_error(pose(w), T_true, x, K, symmetries, norm=norm), (twist, points))
    assert check(lambda w: geodesic_rotation_error(pose(w), T_true, symmetries), (twist,))
    true = twisted(T_true, T_est, T_true[:, :3, 3])
    assert check(lambda w: projection_error(T_est, true(w), points, K, symmetries, norm=norm), (twist,))
    assert check(lambda w: geodesic_rotation_error(T_est, true(w), symmetries), (twist,))


def test_gradients_reach_the_symmetries():
    T_est, T_true, points, _, symmetries = problem(5, degrees=80, count=12)
    offsets = torch.zeros(5, 1, 3, dtype=torch.float64, requires_grad=True)
    shifts = torch.zeros(5, symmetries.transforms.shape[1], 1, 3, dtype=torch.float64, requires_grad=True)

    def error(offsets, shifts):
        moved = torch.cat([torch.zeros_like(shifts).expand(-1, -1, 3, 3), shifts.mT], dim=-1)
        moved = torch.cat([moved, torch.zeros_like(moved[:, :, :1])], dim=2)
        changed = symmetries._replace(
            origins=symmetries.origins + offsets, transforms=symmetries.transforms + moved
        )
        return point_matching_error(T_est, T_true, points, changed, norm="squared")

    assert torch.autograd.gradcheck(error, (offsets, shifts), atol=1e-4)
    for gradient in torch.autograd.grad(error(offsets, shifts).sum(), (offsets, shifts)):
        assert gradient.abs().max() > 1.0


def test_gradient_does_not_turn_about_an_axis_of_symmetry():
    """At the best angle a turn about the axis costs nothing, to first order."""
    T_est, T_true, points, K, _ = problem(12, seed=4, count=300)
    symmetries = ALL.gather(torch.full((12,), list(OBJECTS).index("cone")))
    centre = torch.tensor([*CENTRE], dtype=torch.float64)
    to, back = (make_transform(torch.eye(3).double(), s * centre) for s in (1, -1))
    twist = torch.zeros(12, 6, dtype=torch.float64, requires_grad=True)
    for name, error in all_losses(T_est, T_true @ to @ se3_exp(twist) @ back, points, K, symmetries).items():
        (gradient,) = torch.autograd.grad(error.sum(), twist, retain_graph=True)
        turning, tilting = gradient[:, 5].abs(), gradient[:, 3:5].norm(dim=1)
        # The least sum of absolute values lies at a kink, where one point's share is left.
        assert (turning / tilting).median() < (0.02 if "l1" in name else 1e-6), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_equal_and_opposite_rotations(dtype):
    _, T_true, points, K, symmetries = problem(20)
    turns = [np.zeros(3), *(np.eye(3) * math.pi), np.array([0.6, 0.8, 0.0]) * math.pi]
    R = torch.from_numpy(Rotation.from_rotvec(turns).as_matrix())
    T_true = make_transform(torch.eye(3).double().expand(5, 3, 3), T_true[:5, :3, 3]).repeat(4, 1, 1)
    turn, index = torch.arange(5).repeat_interleave(20), torch.arange(20).repeat(5)  # each with each
    T_est = make_transform(R[turn], T_true[index, :3, 3]).to(dtype).requires_grad_()
    truth = T_true[index].to(dtype).requires_grad_()
    inputs = (T_est, truth, points[index].to(dtype), K[index].to(dtype))
    for used in (None, symmetries.gather(index).to(dtype=dtype)):
        for name, error in all_losses(*inputs, used).items():
            assert torch.isfinite(error).all(), name
            for gradient in torch.autograd.grad(error.sum(), (T_est, truth)):
                assert torch.isfinite(gradient).all(), name
    angle = geodesic_rotation_error(T_est, truth).detach()
    assert torch.allclose(angle, torch.where(turn == 0, 0.0, math.pi).to(dtype), atol=1e-6)
    same = torch.eye(4, dtype=dtype)[None].requires_grad_()
    geodesic_rotation_error(same, torch.eye(4, dtype=dtype)[None]).sum().backward()
    assert (same.grad == 0).all()


def test_rotation_error_is_accurate_near_zero_and_pi():
    axis = np.array([0.48, 0.6, 0.64])
    for angle in (1e-6, 1e-3, math.pi - 1e-3, math.pi - 1e-6):
        R = torch.from_numpy(Rotation.from_rotvec(axis * angle).as_matrix())[None]
        eye = torch.eye(3).double()[None]
        assert geodesic_rotation_error(R, eye).item() == pytest.approx(angle, abs=1e-14)
        assert geodesic_rotation_error(R.float(), eye.float()).item() == pytest.approx(angle, abs=3e-7)


def test_a_sample_does_not_depend_on_its_neighbours():
    T_est, T_true, points, K, symmetries = problem(5)
    T_est.requires_grad_()
    together = all_losses(T_est, T_true, points, K, symmetries)
    for b, entry in enumerate(OBJECTS.values()):
        index = [b]
        # Alone, and without the padding of the other objects' symmetries.
        own = symmetries_from_models_info(entry)
        for name, error in all_losses(T_est[index], T_true[index], points[index], K[index], own).items():
            assert torch.allclose(error[0], together[name][b], rtol=1e-9), name
    gradient = torch.autograd.grad(together["points l2"][3], T_est)[0]
    assert (gradient[[0, 1, 2, 4]] == 0).all()
    assert gradient[3].abs().max() > 0


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e300])
def test_masked_samples_do_not_count(garbage):
    T_est, T_true, points, K, symmetries = problem(6)
    valid = torch.tensor([True, False, True, True, False, True])
    broken = [value.clone() for value in (T_est, T_true, points, K)]
    for value in broken:
        value[~valid] = garbage
    inputs = [value.requires_grad_() for value in broken]
    shared = points[0].clone().requires_grad_()
    spoilt = symmetries.transforms.clone()
    spoilt[~valid] = garbage
    for used in (None, symmetries, symmetries._replace(transforms=spoilt)):
        kept = None if used is None else used.gather(valid.nonzero()[:, 0])
        wanted = all_losses(*(value[valid] for value in (T_est, T_true, points, K)), kept)
        for name, error in all_losses(*inputs, used, valid).items():
            assert (error[~valid] == 0).all(), name
            assert torch.allclose(error[valid], wanted[name], rtol=1e-9), name
            for gradient in torch.autograd.grad(error.sum(), inputs, retain_graph=True, allow_unused=True):
                if gradient is not None:
                    assert torch.isfinite(gradient).all(), name
                    assert (gradient[~valid] == 0).all(), name
        error = point_matching_error(inputs[0], inputs[1], shared, used, valid=valid)
        assert torch.isfinite(torch.autograd.grad(error.sum(), shared)[0]).all()
        nothing = torch.zeros(6, dtype=torch.bool)
        for loss in (
            PointMatchingLoss(reduction="mean")(*inputs[:3], used, valid=nothing),
            ProjectionLoss(reduction="mean")(*inputs, used, valid=nothing),
            GeodesicRotationLoss(reduction="mean")(*inputs[:2], used, valid=nothing),
        ):
            assert loss.item() == 0
            assert (torch.autograd.grad(loss, inputs[0])[0] == 0).all()


def test_unmasked_nan_is_not_hidden():
    T_est, T_true, points, K, symmetries = problem(5)
    T_est[2] = math.nan
    for name, error in all_losses(T_est, T_true, points, K, symmetries).items():
        assert torch.isnan(error).tolist() == [False, False, True, False, False], name


@pytest.mark.parametrize("norm", NORMS)
def test_projection_error_grows_towards_and_behind_the_camera(norm):
    _, T_true, points, K, _ = problem(1, seed=3)
    T_true[:, :2, 3] = 0.0
    forward = torch.linspace(0.0, 3.0, 400, dtype=torch.float64)
    shift = torch.zeros(400, 6, dtype=torch.float64)
    shift[:, 2] = -forward * T_true[0, 2, 3]  # from the true pose to twice its depth behind the camera
    distance = shift.requires_grad_()
    T_est = se3_exp(distance) @ T_true
    error = projection_error(T_est, T_true.expand(400, 4, 4), points[0], K.expand(400, 3, 3), norm=norm)
    assert error[0] < 1e-12
    assert torch.isfinite(error).all()
    assert (error.diff() > 0).all()
    (gradient,) = torch.autograd.grad(error.sum(), distance)
    assert torch.isfinite(gradient).all()
    assert (gradient[1:, 2] < 0).all()  # pushing it away from the camera helps

    behind = T_est.detach()[[130, 140, 399]]
    twist = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    args = (T_true.expand(3, 4, 4), points[0, :5], K.expand(3, 3, 3))
    assert torch.autograd.gradcheck(
        lambda w: projection_error(se3_exp(w) @ behind, *args, norm=norm) * 1e-4,
        (twist,),
        rtol=1e-3,
        atol=1e-4,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_on_the_camera_plane_stay_finite(dtype):
    points = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 5]], dtype=dtype)
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=dtype)[None]
    for true in (0.0, -100.0, 500.0):
        for estimated in (0.0, -1e6, 1e-30, 500.0):
            T_est, T_true = torch.eye(4, dtype=dtype)[None].clone(), torch.eye(4, dtype=dtype)[None].clone()
            T_est[:, 2, 3], T_true[:, 2, 3] = estimated, true
            T_est.requires_grad_()
            error = projection_error(T_est, T_true, points, K)
            assert torch.isfinite(error).all()
            assert torch.isfinite(torch.autograd.grad(error.sum(), T_est)[0]).all()
            assert (error == 0).item() == (abs(true - estimated) < 1)


def test_single_precision_agrees_with_double():
    T_est, T_true, points, K, symmetries = problem(20)
    exact = all_losses(T_est, T_true, points, K, symmetries)
    single = all_losses(*(x.float() for x in (T_est, T_true, points, K)), symmetries.to(dtype=torch.float32))
    for name, error in single.items():
        assert error.dtype == torch.float32
        assert torch.allclose(error.double(), exact[name], rtol=2e-5), name


def test_training_on_a_symmetric_object_finds_an_equivalent_pose():
    """Descent from a pose turned about the axis ends at zero error without turning back."""
    _, T_true, points, _, symmetries = problem(5, seed=9)
    turned = T_true.clone()
    cone, box = list(OBJECTS).index("cone"), list(OBJECTS).index("box")
    turned[cone] = T_true[cone] @ torch.tensor(about((0, 0, 1), 130, CENTRE)).double().reshape(4, 4)
    turned[box] = T_true[box] @ symmetries.transforms[box, 2]
    start = twisted(turned, T_true, T_true[:, :3, 3])
    twist = torch.full((5, 6), 0.1, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([twist], max_iter=80, line_search_fn="strong_wolfe")
    loss = PointMatchingLoss(norm="squared", reduction="sum")

    def closure():
        optimizer.zero_grad()
        value = loss(start(twist), T_true, points, symmetries)
        value.backward()
        return value

    optimizer.step(closure)
    assert loss(start(twist), T_true, points, symmetries).item() < 1e-6
    moved = transform_points(start(twist).detach(), points) - transform_points(T_true, points)
    far = moved.norm(dim=-1).mean(-1)
    assert far[cone] > 20
    assert far[box] > 20
    assert far[list(OBJECTS).index("none")] < 1e-3


def test_bad_input_is_refused():
    T_est, T_true, points, K, _ = problem(5)
    loss = PointMatchingLoss()
    with pytest.raises(
        ValueError, match=r"must both have shape \(B, 4, 4\), got \(5, 4, 4\) and \(4, 4, 4\)"
    ):
        loss(T_est, T_true[:4], points)
    with pytest.raises(
        ValueError, match=r"T_true must be torch\.float64 on cpu as T_est, got torch\.float32"
    ):
        loss(T_est, T_true.float(), points)
    with pytest.raises(ValueError, match="T_est must be floating point"):
        loss(T_est.long(), T_true.long(), points)
    for bad in (points[:3], points[..., :2], points[:, :0]):
        with pytest.raises(ValueError, match="points_model must have shape"):
            loss(T_est, T_true, bad)
    with pytest.raises(ValueError, match=r"points_model must be torch\.float64"):
        loss(T_est, T_true, points.float())
    with pytest.raises(ValueError, match=r"diameter must have shape \(5,\)"):
        loss(T_est, T_true, points, diameter=torch.ones(5, 1).double())
    for bad in (torch.ones(5), torch.ones(4).bool()):
        with pytest.raises(ValueError, match=r"valid must be \(5,\) bool"):
            loss(T_est, T_true, points, valid=bad)
    with pytest.raises(ValueError, match=r"symmetries\.transforms must have shape"):
        loss(T_est, T_true, points, no_symmetries(4, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"K must have shape \(5, 3, 3\)"):
        ProjectionLoss()(T_est, T_true, points, K[0])
    with pytest.raises(ValueError, match=r"\(B, 3, 3\) or \(B, 4, 4\)"):
        GeodesicRotationLoss()(T_est[:, :2, :2], T_true[:, :2, :2])
    with pytest.raises(ValueError, match="norm must be one of l1, l2, squared, got 'l3'"):
        PointMatchingLoss(norm="l3")
    with pytest.raises(ValueError, match="reduction must be one of none, mean, sum"):
        GeodesicRotationLoss(reduction="max")

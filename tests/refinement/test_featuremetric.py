import numpy as np
import pytest
import torch
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry.transforms import rotation_angle, se3_exp
from foundpose.optimization import BarronLoss, Huber, LeastSquares
from foundpose.optimization.local_frame import LocalFrame
from foundpose.refinement import AlignmentProblem, FeaturemetricAlignment
from foundpose.refinement.cost import FeaturemetricCost
from tests.refinement.problems import OFFSET, SIZE, STRIDE, cast, make_problem, perturb, with_maps

SETTINGS = [
    {},
    {"residual": "norm", "loss": BarronLoss(-5.0, 2.0)},
    {"normalize": True, "loss": BarronLoss(-5.0, 0.1)},
    {"interpolation": "bicubic"},
    {"loss": Huber(0.3)},
    {"auto_scale": True},
]
IDS = ["channel", "norm", "normalize", "bicubic", "huber", "auto_scale"]


def build(**settings) -> FeaturemetricAlignment:
    return FeaturemetricAlignment(**settings).double()


def local_equations(module: FeaturemetricAlignment, T: Tensor, problem: AlignmentProblem):
    """The module's equations as a function of the local pose, and the local pose itself."""
    frame = LocalFrame.at(T, problem.points_model, problem.valid.double())
    T_local = frame.pose_to_local(T)
    cost = FeaturemetricCost(
        problem, frame, T_local, module.loss, module.residual, interpolation=module.interpolation
    )
    return lambda T: cost(T).equations, T_local


@pytest.mark.parametrize("settings", SETTINGS[:2] + SETTINGS[3:5], ids=IDS[:2] + IDS[3:5])
def test_normal_equations_against_autograd(settings) -> None:
    problem, T = make_problem(2, points=20, noise=0.3)
    problem.valid[1, 15:] = False
    module = build(**settings)
    evaluate, T_local = local_equations(module, perturb(T, 3.0, 3.0), problem)
    twist = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    equations = evaluate(se3_exp(twist) @ T_local)
    (gradient,) = torch.autograd.grad(equations.cost.sum(), twist)
    torch.testing.assert_close(equations.g.detach(), gradient, rtol=1e-9, atol=1e-10)
    # For least squares H = JᵀJ, J by autograd of the residuals' cost in one patch and channel at a time is slow;
    # at a vanishing residual H is the second derivative.
    exact, T_true = make_problem(2, points=20, noise=0.0)
    plain = build(loss=LeastSquares(), interpolation="bicubic")
    evaluate, T_local = local_equations(plain, T_true, exact)
    twist = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    g = evaluate(se3_exp(twist) @ T_local).g
    second = torch.stack(
        [torch.autograd.grad(g[:, i].sum(), twist, retain_graph=True)[0] for i in range(6)], 1
    )
    torch.testing.assert_close(evaluate(T_local).H.detach(), second, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
def test_finds_the_pose(settings) -> None:
    problem, T = make_problem(8, points=80, noise=0.02)
    start = perturb(T, 4.0, 4.0)
    result = build(**settings)(start, problem)
    assert not result.failed.any()
    assert (result.cost < result.initial_cost).all()
    angle = torch.rad2deg(rotation_angle(result.T_crop_from_model[:, :3, :3], T[:, :3, :3]))
    before = torch.rad2deg(rotation_angle(start[:, :3, :3], T[:, :3, :3]))
    assert (angle < 0.25 * before).all()
    assert angle.median() < 0.5
    assert (result.iterations <= 30).all()
    assert ((result.relative_cost >= 0) & (result.relative_cost <= 1)).all()


def numpy_residuals(problem: AlignmentProblem, b: int, T: np.ndarray) -> np.ndarray:
    """F(π(R x + t)) − p by plain loops over bilinear cells, (P, d)."""
    x, p, K = (t[b].numpy() for t in (problem.points_model, problem.descriptors, problem.K))
    F = problem.maps.values[problem.map_index[b]].numpy()
    camera = x @ T[:3, :3].T + T[:3, 3]
    u = camera @ K.T
    position = (u[:, :2] / u[:, 2:] - OFFSET) / STRIDE
    position = np.clip(position, 0, np.array(F.shape[1::-1]) - 1)
    c, r = np.minimum(np.floor(position).astype(int), np.array(F.shape[1::-1]) - 2).T
    fc, fr = (position - np.stack([c, r], 1)).T
    value = (1 - fr)[:, None] * ((1 - fc)[:, None] * F[r, c] + fc[:, None] * F[r, c + 1])
    value = value + fr[:, None] * ((1 - fc)[:, None] * F[r + 1, c] + fc[:, None] * F[r + 1, c + 1])
    return value - p


@pytest.mark.parametrize("kind", ["least_squares", "cauchy", "barron"])
def test_reaches_scipys_minimum(kind: str) -> None:
    problem, T = make_problem(3, points=60, noise=0.1, seed=4)
    start = perturb(T, 2.0, 2.0)
    loss = {"least_squares": LeastSquares(), "cauchy": BarronLoss(0.0, 0.4), "barron": BarronLoss(-5.0, 0.5)}[
        kind
    ]
    module = build(loss=loss, max_iterations=200, tolerance=1e-14)
    result = module(start, problem)
    for b in range(3):
        T0 = start[b].numpy()

        def pose(v: np.ndarray, T0=T0) -> np.ndarray:
            T = T0.copy()
            T[:3, :3] = Rotation.from_rotvec(v[:3]).as_matrix() @ T0[:3, :3]
            T[:3, 3] += 100 * v[3:]
            return T

        def residuals(v: np.ndarray, b=b, pose=pose) -> np.ndarray:
            return numpy_residuals(problem, b, pose(v)).ravel()

        if kind == "least_squares":
            reference = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-12)
            cost = 2 * reference.cost / 60
        elif kind == "cauchy":
            # scipy's loss is ln(1 + z) of z = (r / f)²; Barron's ρ is 2 c² ln(1 + r² / 2 c²).
            scale = 0.4 * np.sqrt(2)
            reference = least_squares(
                residuals, np.zeros(6), loss="cauchy", f_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-12
            )
            cost = 2 * reference.cost / 60
        else:

            def barron(v: np.ndarray, residuals=residuals) -> float:
                z = (residuals(v) / 0.5) ** 2
                return float((2 * 0.25 * 7 / 5 * (1 - (z / 7 + 1) ** -2.5)).sum() / 60)

            reference = minimize(barron, np.zeros(6), method="BFGS", options={"gtol": 1e-10})
            cost = reference.fun
        assert result.cost[b].item() == pytest.approx(cost, rel=1e-4)
        R = torch.from_numpy(pose(reference.x))[:3, :3]
        assert rotation_angle(result.T_crop_from_model[b, :3, :3], R) < 1e-3
        np.testing.assert_allclose(result.T_crop_from_model[b].numpy(), pose(reference.x), atol=0.2)


def pose_values(T: Tensor) -> Tensor:
    return torch.cat([T[:, :3, :3], T[:, :3, 3:] / 600], dim=-1)


@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize("settings", [SETTINGS[0], SETTINGS[1], SETTINGS[2]], ids=IDS[:3])
def test_gradients_against_finite_differences(mode: str, settings) -> None:
    problem, T = make_problem(2, points=30, noise=0.05)
    start = perturb(T, 1.0, 1.0)
    settings = settings | {"interpolation": "bicubic", "max_iterations": 40, "tolerance": 0.0}
    module = build(differentiation=mode, **settings)
    generator = torch.Generator().manual_seed(0)
    probe = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)

    names = ("maps", "descriptors", "points_model", "K")
    values = {name: problem.maps.values if name == "maps" else getattr(problem, name) for name in names}

    def value(**changed: Tensor) -> Tensor:
        maps, *others = (values | changed).values()
        changed_problem = with_maps(problem, maps)._replace(**dict(zip(names[1:], others, strict=True)))
        return (pose_values(module(start, changed_problem).T_crop_from_model) * probe).sum()

    leaves = {name: x.clone().requires_grad_() for name, x in values.items()}
    gradients = torch.autograd.grad(value(**leaves), list(leaves.values()))
    for (name, x), gradient in zip(values.items(), gradients, strict=True):
        assert gradient.abs().max() > 0
        direction = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        if name == "K":
            direction = direction * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
        step = 1e-3
        numeric = [value(**{name: x + s * direction}) for s in (step, -step)]
        expected = (numeric[0] - numeric[1]).item() / (2 * step)
        assert (gradient * direction).sum().item() == pytest.approx(expected, rel=1e-2, abs=1e-7), name


def test_implicit_and_unrolled_agree() -> None:
    problem, T = make_problem(3, points=30, noise=0.05)
    gradients = []
    for mode in ("implicit", "unrolled"):
        module = build(
            differentiation=mode, interpolation="bicubic", max_iterations=60, tolerance=0.0,
            loss=BarronLoss(-5.0, 0.5, learnable=True),
        )  # fmt: skip
        leaves = [x.clone().requires_grad_() for x in (problem.maps.values, problem.descriptors)]
        changed = with_maps(problem, leaves[0])._replace(descriptors=leaves[1])
        out = module(perturb(T, 1.0, 1.0), changed).T_crop_from_model
        gradients.append(
            torch.autograd.grad(pose_values(out).square()[:, :2].sum(), [*leaves, *module.parameters()])
        )
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


def test_a_start_at_the_optimum_has_its_gradient() -> None:
    problem, T = make_problem(2, points=30, noise=0.05)
    settled = T
    for _ in range(6):
        settled = build(max_iterations=100, tolerance=0.0)(settled, problem).T_crop_from_model
    leaf = problem.descriptors.clone().requires_grad_()
    result = build()(settled, problem._replace(descriptors=leaf))
    kept = result.cost >= result.initial_cost
    assert kept.any()
    assert torch.equal(result.T_crop_from_model[kept], settled[kept])
    (gradient,) = torch.autograd.grad(pose_values(result.T_crop_from_model).square()[:, :, 3].sum(), leaf)
    assert torch.isfinite(gradient).all()
    assert (gradient[kept].abs().amax((1, 2)) > 0).all()


def test_unrolled_gradient_of_the_start() -> None:
    problem, T = make_problem(1, points=30)
    module = build(differentiation="unrolled", interpolation="bicubic", max_iterations=2)
    start = perturb(T, 2.0, 2.0)

    def value(twist: Tensor) -> Tensor:
        return pose_values(module(se3_exp(twist) @ start, problem).T_crop_from_model).sum()

    twist = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(twist), twist)
    for k in range(6):
        step = torch.zeros_like(twist)
        step[:, k] = 1e-6
        numeric = (value(twist + step) - value(twist - step)).item() / 2e-6
        assert gradient[0, k].item() == pytest.approx(numeric, rel=1e-4, abs=1e-6)


def test_losing_patches_never_looks_like_progress() -> None:
    """Descriptors that match nothing: moving out of the crop would spare all residuals, but costs the ceiling."""
    problem, T = make_problem(4, points=40)
    hopeless = problem._replace(descriptors=-problem.descriptors)
    start = T.clone()
    start[:, 0, 3] += 55.0  # a part is out of the crop already
    for settings in SETTINGS[:2] + SETTINGS[4:5]:
        module = build(**settings)
        result = module(start, hopeless)
        seen_before, seen_after = (visible(problem, pose) for pose in (start, result.T_crop_from_model))
        assert (result.cost <= result.initial_cost).all()
        assert (seen_after >= 0.5 * seen_before).all()
        gone = T.clone()
        gone[:, 0, 3] += 1e4
        lost = module(gone, problem)
        assert lost.failed.all()
        assert torch.equal(lost.T_crop_from_model, gone)
        torch.testing.assert_close(lost.relative_cost, torch.ones(4, dtype=torch.float64))
        assert (lost.cost > module(T, problem).cost).all()
        behind = T.clone()
        behind[:, 2, 3] = -600.0
        torch.testing.assert_close(module(behind, problem).cost, lost.cost)


def visible(problem: AlignmentProblem, T: Tensor) -> Tensor:
    camera = (problem.points_model @ T[:, :3, :3].mT + T[:, None, :3, 3]) @ problem.K.mT
    pixels = camera[..., :2] / camera[..., 2:]
    return ((pixels > -0.5) & (pixels < SIZE - 0.5)).all(-1).sum(-1)


def test_never_worse_and_the_start_comes_back_bit_for_bit() -> None:
    problem, T = make_problem(6, points=30, noise=3.0)
    module = build()
    once = module(perturb(T, 5.0, 5.0), problem)
    assert (once.cost <= once.initial_cost).all()
    again = module(once.T_crop_from_model, problem)
    settled = again.cost >= again.initial_cost
    assert torch.equal(again.T_crop_from_model[settled], once.T_crop_from_model[settled])
    start = perturb(T, 5.0, 5.0)
    start[2] = torch.nan
    problem.valid[4] = False
    result = module(start, problem)
    assert result.failed.tolist() == [False, False, True, False, True, False]
    assert torch.equal(result.T_crop_from_model[4], start[4])
    assert torch.isnan(result.T_crop_from_model[2]).all()
    assert torch.isinf(result.covariance[4].diagonal()).all()


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
def test_alone_as_in_a_batch_and_padded(settings) -> None:
    problem, T = make_problem(4, points=30, noise=0.1)
    start = perturb(T, 3.0, 3.0)
    module = build(**settings)
    together = module(start, problem)
    n = torch.zeros(1, dtype=torch.int64)
    for b in range(4):
        padding = (0, 0, 0, 7)
        alone = with_maps(problem, problem.maps.values[b : b + 1])._replace(
            map_index=n,
            K=problem.K[b : b + 1],
            descriptors=torch.nn.functional.pad(problem.descriptors[b : b + 1], padding, value=9.0),
            points_model=torch.nn.functional.pad(problem.points_model[b : b + 1], padding, value=9.0),
            valid=torch.nn.functional.pad(problem.valid[b : b + 1], (0, 7)),
        )
        result = module(start[b : b + 1], alone)
        torch.testing.assert_close(
            result.T_crop_from_model[0], together.T_crop_from_model[b], rtol=1e-6, atol=1e-5
        )
        torch.testing.assert_close(result.cost[0], together.cost[b], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("settings", SETTINGS[1:3] + SETTINGS[5:], ids=IDS[1:3] + IDS[5:])
def test_converges_in_float32_on_descriptors_of_norm_40(settings) -> None:
    problem, T = make_problem(6, points=80, norm=40.0, noise=0.2, channels=64)
    start = perturb(T, 3.0, 3.0)
    if "residual" in settings:
        settings = settings | {"loss": BarronLoss(-5.0, 5.0)}
    single = FeaturemetricAlignment(**settings)(start.float(), cast(problem, torch.float32))
    double = build(**settings)(start, problem)
    for result in (single, double):
        angle = rotation_angle(result.T_crop_from_model[:, :3, :3].double(), T[:, :3, :3])
        assert torch.rad2deg(angle).median() < 0.5
    torch.testing.assert_close(
        single.T_crop_from_model.double(), double.T_crop_from_model, rtol=1e-3, atol=0.3
    )


def test_covariance_tells_directions_apart() -> None:
    problem, T = make_problem(2, points=60, noise=0.3)
    covariance = build()(T, problem).covariance
    torch.testing.assert_close(covariance, covariance.mT)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()
    # Of the object's centre, the depth is known least: x ↦ v + ω × x.
    centre = T[:, :3, 3]
    by_twist = torch.cat([torch.eye(3).double().expand(2, 3, 3), -skew(centre)], dim=-1)
    displacement = by_twist @ covariance @ by_twist.mT
    assert (displacement[:, 2, 2] > 5 * displacement[:, 0, 0]).all()
    assert (displacement[:, 2, 2] > 5 * displacement[:, 1, 1]).all()
    more, _ = make_problem(2, points=60, noise=0.6)
    wider = by_twist @ build()(T, more).covariance @ by_twist.mT
    assert (wider[:, 0, 0] > 2 * displacement[:, 0, 0]).all()


def skew(v: Tensor) -> Tensor:
    return torch.linalg.cross(v.unsqueeze(-1).expand(-1, 3, 3), torch.eye(3).double().expand(2, 3, 3), dim=-2)


def test_bad_arguments() -> None:
    for arguments, message in [
        ({"residual": "patch"}, "'channel' or 'norm', got 'patch'"),
        ({"interpolation": "nearest"}, "'bilinear' or 'bicubic', got 'nearest'"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
        ({"auto_scale": True, "loss": LeastSquares()}, "needs a loss with a scale, got LeastSquares"),
        ({"differentiation": "adjoint"}, "'implicit' or 'unrolled', got 'adjoint'"),
    ]:
        with pytest.raises(ValueError, match=message):
            FeaturemetricAlignment(**arguments)


def test_blocks_of_poses_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, T = make_problem(7, points=20, noise=0.1)
    start = perturb(T, 3.0, 3.0)
    together = build()(start, problem)
    monkeypatch.setattr("foundpose.refinement.featuremetric._CPU_NUMBERS_PER_BLOCK", 3 * 20 * 16)
    apart = build()(start, problem)
    for one, other in zip(together, apart, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)

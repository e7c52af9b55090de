import math

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry.cameras import project_points
from foundpose.geometry.transforms import make_transform, rotation_angle, se3_exp, transform_points
from foundpose.optimization import BarronLoss, Huber
from foundpose.pnp import LevenbergMarquardtPnp, PnpProblem
from tests.pnp.scenes import make_scene, stack

LOSSES = {"least_squares": None, "huber": Huber(3.0), "barron": BarronLoss(0.0, 5.0).double()}


def problems(
    count: int, points: int, noise: float = 1.0, seed: int = 0, shape: str = "volume", wide: bool = True
):
    """Noisy correspondences, intrinsics, weights, and starts near the optimum; float64."""
    rng = np.random.default_rng(seed)
    scenes = [make_scene(rng, points, shape, wide) for _ in range(count)]
    image, model, K, _ = stack(scenes, torch.float64)
    image = image + noise * torch.from_numpy(rng.normal(size=image.shape))
    weights = torch.from_numpy(rng.uniform(0.2, 1.0, image.shape[:2]))
    T = make_transform(
        torch.from_numpy(np.stack([s.R for s in scenes])), torch.from_numpy(np.stack([s.t for s in scenes]))
    )
    twist = 0.02 * torch.from_numpy(rng.normal(size=(count, 6)))
    twist[:, :3] *= torch.tensor([s.diameter for s in scenes])[:, None]
    # Perturbed about the object's centre.
    return image, model, K, weights, perturb(T, twist)


def perturb(T: Tensor, twist: Tensor) -> Tensor:
    R = se3_exp(torch.cat([torch.zeros_like(twist[:, :3]), twist[:, 3:]], dim=1))[:, :3, :3]
    return make_transform(R @ T[:, :3, :3], T[:, :3, 3] + twist[:, :3])


@pytest.mark.parametrize("loss", LOSSES)
def test_reaches_scipys_optimum(loss: str) -> None:
    image, model, K, weights, T0 = problems(4, 30, noise=2.0)
    optimum = LevenbergMarquardtPnp(LOSSES[loss], max_iterations=100)(
        T0, PnpProblem(image, model, K, weights=weights)
    )
    assert optimum.converged.all()
    assert (optimum.cost <= optimum.initial_cost).all()
    scale = {"huber": 3.0, "barron": 5.0, "least_squares": 1.0}[loss]
    for b in range(4):
        u, x, k, w = (t[b].numpy() for t in (image, model, K, weights))

        def distances(p: np.ndarray, u=u, x=x, k=k) -> np.ndarray:
            y = (x @ Rotation.from_rotvec(p[:3]).as_matrix().T + p[3:]) @ k.T
            return np.linalg.norm(y[:, :2] / y[:, 2:] - u, axis=1)

        def residuals(p: np.ndarray, w=w, distances=distances) -> np.ndarray:
            # Residuals whose squares are w ρ(r²).
            r = distances(p)
            if loss == "huber":
                r = np.sqrt(np.where(r <= scale, r**2, 2 * scale * r - scale**2))
            elif loss == "barron":
                r = np.sqrt(2 * scale**2 * np.log1p(0.5 * (r / scale) ** 2))
            return np.sqrt(w) * r

        T = optimum.T_camera_from_model[b].numpy()
        start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
        reference = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert optimum.cost[b].item() == pytest.approx(reference.cost, rel=1e-8)
        R = torch.from_numpy(Rotation.from_rotvec(reference.x[:3]).as_matrix())
        assert rotation_angle(optimum.T_camera_from_model[b, :3, :3], R) < 1e-5


def pose_function(mode: str, loss, T0: Tensor):
    module = LevenbergMarquardtPnp(loss, max_iterations=80, tolerance=0.0, differentiation=mode)

    def run(image: Tensor, model: Tensor, K: Tensor, weights: Tensor) -> Tensor:
        T = module(T0, PnpProblem(image, model, K, weights=weights)).T_camera_from_model
        # Translations in units of the distance, so that one tolerance suits all entries.
        return torch.cat([T[:, :3, :3], T[:, :3, 3:] / T0[:, 2:3, 3:]], dim=-1)

    return run


@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize("loss", LOSSES)
def test_gradcheck(mode: str, loss: str) -> None:
    image, model, K, weights, T0 = problems(1, 6, noise=2.0)
    inputs = [x.clone().requires_grad_() for x in (image, model, K, weights)]
    run = pose_function(mode, LOSSES[loss], T0)
    # The optimum is known to the square root of rounding, so the differences must not be too small.
    # All entries for one, random projections (fast mode) for the others.
    whole = (mode, loss) == ("implicit", "least_squares")
    assert torch.autograd.gradcheck(run, inputs, eps=2e-3, atol=2e-6, rtol=2e-3, fast_mode=not whole)


@pytest.mark.parametrize("loss", LOSSES)
def test_implicit_and_unrolled_agree(loss: str) -> None:
    image, model, K, weights, T0 = problems(5, 20, noise=3.0, seed=1)
    direction = torch.randn(5, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gradients = []
    for mode in ("implicit", "unrolled"):
        inputs = [x.clone().requires_grad_() for x in (image, model, K, weights)]
        value = (pose_function(mode, LOSSES[loss], T0)(*inputs) * direction).sum()
        gradients.append(torch.autograd.grad(value, inputs))
    for implicit, unrolled in zip(*gradients, strict=True):
        torch.testing.assert_close(implicit, unrolled, rtol=1e-4, atol=1e-5 * float(unrolled.abs().max()))


def test_unrolled_gradient_of_the_start() -> None:
    # After two iterations the result still depends on where they began.
    image, model, K, weights, T0 = problems(1, 8, noise=2.0)

    def run(twist: Tensor, mode: str = "unrolled") -> Tensor:
        module = LevenbergMarquardtPnp(max_iterations=2, tolerance=0.0, differentiation=mode)
        return module(se3_exp(twist) @ T0, PnpProblem(image, model, K, weights=weights)).T_camera_from_model[
            :, :3
        ]

    twist = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(run(twist).sum(), twist)
    assert gradient.abs().max() > 1e-8
    for k in range(6):
        step = torch.zeros_like(twist)
        step[:, k] = 1e-5
        numeric = (run(twist + step) - run(twist - step)).sum() / 2e-5
        assert gradient[0, k].item() == pytest.approx(numeric.item(), rel=1e-4, abs=1e-6)
    assert not run(twist.detach(), "implicit").requires_grad


def test_gradient_of_the_loss_parameters() -> None:
    image, model, K, weights, T0 = problems(1, 10, noise=1.0)
    image[0, 0] += 15.0
    loss = BarronLoss(-1.0, 2.0, learnable=True).double()

    def rotation() -> Tensor:
        return LevenbergMarquardtPnp(loss, 300, tolerance=0.0)(
            T0, PnpProblem(image, model, K, weights=weights)
        ).T_camera_from_model[0, 0, 1]

    gradient = torch.autograd.grad(rotation(), list(loss.parameters()))
    for parameter, slope in zip(loss.parameters(), gradient, strict=True):
        values = []
        for step in (1e-2, -1e-2):
            with torch.no_grad():
                parameter += step
                values.append(rotation().item())
                parameter -= step
        assert slope.item() == pytest.approx((values[0] - values[1]) / 2e-2, rel=2e-3)


@pytest.mark.parametrize("noise", [None, 1.5])
def test_covariance_against_monte_carlo(noise: float | None) -> None:
    trials = 4000
    image, model, K, _, _ = problems(1, 12, noise=0.0, seed=3)
    scene = make_scene(np.random.default_rng(3), 12, "volume", True)
    T = make_transform(torch.from_numpy(scene.R), torch.from_numpy(scene.t))[None]
    draws = torch.randn(trials, 12, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    module = LevenbergMarquardtPnp(noise=noise)
    with torch.no_grad():
        optimum = module(
            T.expand(trials, 4, 4),
            PnpProblem(image + 1.5 * draws, model.expand(trials, -1, -1), K.expand(trials, 3, 3)),
        )
    # δ with exp(δ) T_true = T, to first order.
    delta = optimum.T_camera_from_model @ torch.linalg.inv(T)
    twist = torch.stack(
        [delta[:, 0, 3], delta[:, 1, 3], delta[:, 2, 3], delta[:, 2, 1], delta[:, 0, 2], delta[:, 1, 0]],
        dim=1,
    )
    sampled = torch.cov(twist.T)
    predicted = optimum.covariance.mean(0)
    root = sampled.diagonal().sqrt()
    scaled = (predicted - sampled) / (root[:, None] * root[None])
    assert scaled.abs().max() < 0.12
    assert torch.allclose(predicted, predicted.T)


def test_covariance_scales_with_weights_and_says_when_there_is_none() -> None:
    image, model, K, _, T0 = problems(1, 12, noise=1.0)
    weights = torch.ones(1, 12, dtype=torch.float64)
    known = LevenbergMarquardtPnp(noise=1.0)
    once = known(T0, PnpProblem(image, model, K, weights=weights)).covariance
    torch.testing.assert_close(
        known(T0, PnpProblem(image, model, K, weights=4 * weights)).covariance, once / 4, rtol=1e-6, atol=0
    )
    estimated = LevenbergMarquardtPnp()
    a, b = (estimated(T0, PnpProblem(image, model, K, weights=s * weights)).covariance for s in (1, 4))
    torch.testing.assert_close(a, b, rtol=1e-6, atol=0)
    # Three points determine the pose but leave nothing to estimate the noise from; two do not even do that.
    weights[:, 3:] = 0.0
    assert torch.isinf(
        estimated(T0, PnpProblem(image, model, K, weights=weights)).covariance.diagonal(dim1=1, dim2=2)
    ).all()
    assert torch.isfinite(known(T0, PnpProblem(image, model, K, weights=weights)).covariance).all()
    weights[:, 2:] = 0.0
    assert torch.isinf(
        known(T0, PnpProblem(image, model, K, weights=weights)).covariance.diagonal(dim1=1, dim2=2)
    ).all()


def test_covariance_of_a_robust_loss_counts_the_outliers_out() -> None:
    image, model, K, _, T0 = problems(1, 40, noise=1.0, seed=2)
    spoilt = image.clone()
    spoilt[:, :8] += 200.0
    clean = (
        LevenbergMarquardtPnp()(T0, PnpProblem(image, model, K)).covariance.diagonal(dim1=1, dim2=2).sqrt()
    )
    robust = LevenbergMarquardtPnp(BarronLoss(-5.0, 3.0).double(), 100)(T0, PnpProblem(spoilt, model, K))
    plain = LevenbergMarquardtPnp(max_iterations=100)(T0, PnpProblem(spoilt, model, K))
    assert (robust.covariance.diagonal(dim1=1, dim2=2).sqrt() / clean < 2.0).all()
    assert (plain.covariance.diagonal(dim1=1, dim2=2).sqrt() / clean > 5.0).all()


HARD = [
    "identity",
    "half_turn",
    "coplanar",
    "exact_fit",
    "four_points",
    "collinear",
    "one_point",
    "no_point",
    "nan_pose",
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize("case", HARD)
def test_gradients_are_finite_at_hard_cases(case: str, mode: str, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    model = torch.rand(1, 12, 3, generator=generator, dtype=torch.float64) * 100 - 50
    R = torch.eye(3, dtype=torch.float64)
    if case == "half_turn":
        R = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    if case == "coplanar":
        model[..., 2] = 0.0
    if case == "collinear":
        model = model[:, :1] * torch.linspace(-1, 1, 12, dtype=torch.float64)[None, :, None]
    T = make_transform(R, torch.tensor([3.0, -5.0, 400.0], dtype=torch.float64))[None]
    K = torch.tensor([[[600.0, 0, 210], [0, 600.0, 210], [0, 0, 1]]], dtype=torch.float64)
    image = project_points(transform_points(T, model), K)[0]
    if case != "exact_fit":
        image = image + torch.randn(image.shape, generator=generator, dtype=torch.float64)
    weights = torch.ones(1, 12, dtype=torch.float64)
    keep = {"four_points": 4, "one_point": 1, "no_point": 0}.get(case, 12)
    weights[:, keep:] = 0.0
    start = T.clone()
    if case == "nan_pose":
        start[:] = math.nan
    inputs = [x.to(dtype).requires_grad_() for x in (image, model, K, weights)]
    module = LevenbergMarquardtPnp(differentiation=mode)
    optimum = module(start.to(dtype), PnpProblem(*inputs[:3], weights=inputs[3]))
    angle = optimum.T_camera_from_model[:, :3].square().sum()
    gradients = torch.autograd.grad(angle, inputs, allow_unused=True)
    for gradient in gradients:
        assert gradient is None or torch.isfinite(gradient).all()
    assert bool(optimum.failed) == (case in ("no_point", "nan_pose"))
    if case not in ("collinear", "one_point", "no_point", "nan_pose"):
        if not (case == "exact_fit" and mode == "unrolled"):  # which takes no step
            assert gradients[0][:, :keep].abs().amax(-1).min() > 0
        if mode == "implicit":
            reference = pose_gradient(T, [x.detach().double() for x in inputs])
            error = (gradients[0].double() - reference).abs().max() / reference.abs().max()
            assert error < (2e-2 if dtype == torch.float32 else 1e-6)


def pose_gradient(T: Tensor, inputs: list[Tensor]) -> Tensor:
    """The gradient with respect to the image points by unrolling many iterations in float64."""
    image = inputs[0].requires_grad_()
    module = LevenbergMarquardtPnp(max_iterations=50, tolerance=0.0, differentiation="unrolled")
    # Steps have to be taken: an exact fit would stay where it is.
    twist = torch.tensor([[3.0, -2.0, 4.0, 0.03, -0.02, 0.01]], dtype=torch.float64)
    T = module(perturb(T, twist), PnpProblem(image, *inputs[1:3], weights=inputs[3])).T_camera_from_model
    return torch.autograd.grad(T[:, :3].square().sum(), image)[0]


def test_gradients_do_not_depend_on_the_batch() -> None:
    image, model, K, weights, T0 = problems(5, 15, noise=3.0, seed=4)
    weights[2] = 0.0  # a hopeless neighbour
    leaves = [x.clone().requires_grad_() for x in (image, model, K, weights)]
    T = LevenbergMarquardtPnp()(T0, PnpProblem(*leaves[:3], weights=leaves[3])).T_camera_from_model
    together = torch.autograd.grad(T[:, :3].square().sum(), leaves)
    for b in range(5):
        alone_leaves = [x[b : b + 1].clone().requires_grad_() for x in (image, model, K, weights)]
        alone_T = LevenbergMarquardtPnp()(
            T0[b : b + 1], PnpProblem(*alone_leaves[:3], weights=alone_leaves[3])
        ).T_camera_from_model
        assert torch.equal(alone_T[0], T[b])
        alone = torch.autograd.grad(alone_T[:, :3].square().sum(), alone_leaves, allow_unused=True)
        for one, many in zip(alone, together, strict=True):
            torch.testing.assert_close(
                one[0] if one is not None else 0 * many[b], many[b], rtol=1e-9, atol=1e-9
            )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize("case", ["one_point", "two_points", "line", "repeated", "flat_and_far"])
def test_hopeless_neighbours_disturb_nobody(case: str, mode: str, dtype: torch.dtype) -> None:
    """Sixty problems without a unique pose beside a healthy one: finite, shared parameters included."""
    image, model, K, weights, T0 = problems(61, 12, noise=2.0, seed=5)
    bad = slice(1, None)
    if case in ("one_point", "two_points"):
        weights[bad, 1 if case == "one_point" else 2 :] = 0.0
    elif case == "line":
        model[bad] = model[bad, :1] * torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None]
    elif case == "repeated":
        model[bad] = model[bad, :2].repeat_interleave(6, dim=1)
        image[bad] = image[bad, :2].repeat_interleave(6, dim=1)
    else:
        model[bad, :, 2] = 0.0
        T0[bad] = make_transform(torch.eye(3, dtype=torch.float64).expand(60, 3, 3), 300 * T0[bad, :3, 3])
        image[bad] = project_points(transform_points(T0[bad], model[bad]), K[bad])[0] + 0.1 * image[bad].sin()
    T0, image, model, K, weights = (x.to(dtype) for x in (T0, image, model, K, weights))
    module = LevenbergMarquardtPnp(max_iterations=30, differentiation=mode)

    def gradients(rows: slice) -> list[Tensor]:
        count = len(T0[rows])
        shared = [x[:1].clone().requires_grad_() for x in (K, weights)]  # parameters that all problems use
        points = image[rows].clone().requires_grad_()
        optimum = module(
            T0[rows],
            PnpProblem(
                points,
                model[rows],
                K[rows] + (shared[0] - K[:1]).expand(count, 3, 3),
                weights=weights[rows] * (1 + (shared[1] - weights[:1])),
            ),
        )
        assert torch.isfinite(optimum.T_camera_from_model).all()
        value = optimum.T_camera_from_model[:1, :3].square().sum()
        rest = optimum.T_camera_from_model[1:, :3].square().sum()
        every = torch.autograd.grad(value + rest, [points, *shared], retain_graph=True)
        assert all(torch.isfinite(g).all() for g in every)
        return list(torch.autograd.grad(value, [points, *shared]))

    together, alone = gradients(slice(None)), gradients(slice(0, 1))
    assert (together[0][1:] == 0).all()
    for many, one in zip(together, alone, strict=True):
        scale = float(one.abs().max())
        torch.testing.assert_close(
            many[:1] / scale, one / scale, rtol=0, atol=1e-4 if dtype == torch.float32 else 1e-9
        )


def test_a_failed_pose_has_no_covariance() -> None:
    image, model, K, weights, T0 = problems(2, 10)
    T0[1, 2, 3] = -T0[1, 2, 3]
    optimum = LevenbergMarquardtPnp(noise=1.0)(
        T0, PnpProblem(image.requires_grad_(), model, K, weights=weights)
    )
    assert optimum.failed.tolist() == [False, True]
    assert optimum.regular.tolist() == [True, False]
    assert torch.isinf(optimum.covariance[1].diagonal()).all()
    assert torch.isfinite(optimum.covariance[0]).all()


def test_padding_has_no_influence() -> None:
    image, model, K, weights, T0 = problems(2, 10, noise=2.0)
    garbage = torch.full((2, 4, 3), 1e3, dtype=torch.float64)
    padded = LevenbergMarquardtPnp()(
        T0,
        PnpProblem(
            torch.cat([image, garbage[..., :2]], 1),
            torch.cat([model, garbage], 1),
            K,
            weights=torch.cat([weights, torch.zeros(2, 4, dtype=torch.float64)], 1),
        ),
    )
    plain = LevenbergMarquardtPnp()(T0, PnpProblem(image, model, K, weights=weights))
    torch.testing.assert_close(padded.T_camera_from_model, plain.T_camera_from_model, rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(padded.covariance, plain.covariance, rtol=1e-5, atol=0)


def test_the_same_with_and_without_gradient() -> None:
    image, model, K, weights, T0 = (x.float() for x in problems(3, 10, noise=2.0))
    with torch.no_grad():
        plain = LevenbergMarquardtPnp()(T0, PnpProblem(image, model, K, weights=weights))
    graph = LevenbergMarquardtPnp()(T0, PnpProblem(image.requires_grad_(), model, K, weights=weights))
    assert torch.equal(plain.T_camera_from_model, graph.T_camera_from_model)
    assert torch.equal(plain.covariance, graph.covariance)
    assert not graph.covariance.requires_grad


def saved_bytes(mode: str, iterations: int) -> int:
    """Bytes that autograd keeps from a forward pass for the backward pass."""
    image, model, K, weights, T0 = problems(4, 200, noise=20.0)
    seen: dict[int, int] = {}

    def pack(x: Tensor) -> Tensor:
        storage = x.untyped_storage()
        seen[storage.data_ptr()] = storage.nbytes()
        kept.append(x)  # a freed block's address could come back
        return x

    kept: list[Tensor] = []
    module = LevenbergMarquardtPnp(max_iterations=iterations, tolerance=0.0, differentiation=mode)
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        optimum = module(T0, PnpProblem(image.requires_grad_(), model, K, weights=weights))
    assert optimum.iterations.max() >= min(iterations, 15)
    optimum.T_camera_from_model.sum().backward()
    return sum(seen.values())


def test_memory_of_the_implicit_gradient_does_not_grow_with_iterations() -> None:
    few, many = saved_bytes("implicit", 2), saved_bytes("implicit", 40)
    assert many == few
    # Unrolled, it grows until the samples have converged.
    assert saved_bytes("unrolled", 40) > 5 * saved_bytes("unrolled", 2)
    assert saved_bytes("unrolled", 40) > 10 * many


def test_bad_arguments() -> None:
    for arguments, message in [
        ({"max_iterations": 0}, "max_iterations must be at least 1, got 0"),
        ({"tolerance": -1.0}, "tolerance must not be negative"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"differentiation": "finite"}, "'implicit' or 'unrolled', got 'finite'"),
    ]:
        with pytest.raises(ValueError, match=message):
            LevenbergMarquardtPnp(**arguments)
    image, model, K, weights, T0 = problems(2, 10)
    with pytest.raises(ValueError, match=r"weights must have shape \(2, 10\), got \(2, 9\)"):
        LevenbergMarquardtPnp()(T0, PnpProblem(image, model, K, weights=weights[:, :9]))

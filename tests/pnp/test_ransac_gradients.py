import numpy as np
import pytest
import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform
from foundpose.optimization import BarronLoss
from foundpose.pnp import LevenbergMarquardtPnp, PnpProblem, RansacPnp, SoftInlierSelection
from foundpose.pnp.soft_selection import choose_softly
from tests.pnp.scenes import make_scene, stack


def problems(
    count: int = 3,
    points: int = 40,
    outliers: float = 0.3,
    noise: float = 1.5,
    seed: int = 0,
    shape="ellipsoid",
):
    """Image points, model points, intrinsics, weights (float64) and which points are outliers."""
    rng = np.random.default_rng(seed)
    image, model, K, _ = stack(
        [make_scene(rng, points, shape, wide=True) for _ in range(count)], torch.float64
    )
    image = image + noise * torch.from_numpy(rng.normal(size=image.shape))
    wrong = torch.from_numpy(rng.random(image.shape[:2]) < outliers)
    image = torch.where(wrong[..., None], torch.from_numpy(rng.uniform(0, 420, image.shape)), image)
    weights = torch.from_numpy(rng.uniform(0.2, 1.0, image.shape[:2]))
    return image, model, K, weights, wrong


def precise(mode: str = "implicit", loss=None) -> LevenbergMarquardtPnp:
    return LevenbergMarquardtPnp(loss, max_iterations=80, tolerance=0.0, differentiation=mode)


def scaled(T: Tensor) -> Tensor:
    """Rotation and translation in units of the distance."""
    return torch.cat([T[..., :3, :3], T[..., :3, 3:] / T[..., 2:3, 3:].detach()], dim=-1)


@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize("loss", [None, BarronLoss(0.0, 5.0).double()])
def test_gradient_through_the_inliers_against_finite_differences(mode: str, loss) -> None:
    *inputs, _ = problems()
    ransac = RansacPnp(polish=precise(mode, loss))
    leaves = [x.clone().requires_grad_() for x in inputs]
    chosen = ransac(PnpProblem(*leaves[:3], weights=leaves[3]))
    assert chosen.success.all()
    generator = torch.Generator().manual_seed(0)
    probe = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad((scaled(chosen.T_camera_from_model) * probe).sum(), leaves)
    scale = chosen.T_camera_from_model[:, 2:3, 3:].detach()
    for k, gradient in enumerate(gradients):
        direction = torch.randn(inputs[k].shape, generator=generator, dtype=torch.float64)
        if k == 2:
            direction = direction * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
        values = []
        for step in (1e-3, -1e-3):
            moved = list(inputs)
            moved[k] = inputs[k] + step * direction
            result = ransac(PnpProblem(*moved[:3], weights=moved[3]))
            assert torch.equal(
                result.inliers, chosen.inliers
            )  # the choice is the same, so there is a derivative
            T = result.T_camera_from_model
            values.append((torch.cat([T[:, :3, :3], T[:, :3, 3:] / scale], -1) * probe).sum())
        numeric = (values[0] - values[1]) / 2e-3
        analytic = (gradient * direction).sum()
        assert analytic.item() == pytest.approx(numeric.item(), rel=5e-3, abs=1e-7), k


def test_only_inliers_have_gradients() -> None:
    image, model, K, weights, _ = problems()
    valid = torch.ones(3, 40, dtype=torch.bool)
    valid[1, :5] = False
    leaves = [x.requires_grad_() for x in (image, model, K, weights)]
    result = RansacPnp()(PnpProblem(*leaves[:3], valid, leaves[3]))
    result.T_camera_from_model[:, :3].square().sum().backward()
    for leaf in (image, model, weights):
        size = leaf.grad.abs().reshape(3, 40, -1).sum(-1)
        assert (size[result.inliers] > 0).all()
        assert (size[~result.inliers] == 0).all()


def test_the_same_with_and_without_gradient() -> None:
    image, model, K, weights, _ = (x.float() if x.is_floating_point() else x for x in problems())
    for soft in (None, SoftInlierSelection(4)):
        ransac = RansacPnp(soft_selection=soft)
        with torch.no_grad():
            plain = ransac(PnpProblem(image, model, K, weights=weights))
        graph = ransac(PnpProblem(image.clone().requires_grad_(), model, K, weights=weights))
        assert torch.equal(plain.T_camera_from_model, graph.T_camera_from_model)
        assert torch.equal(plain.inliers, graph.inliers)


@pytest.mark.parametrize("soft", [None, SoftInlierSelection(4)])
def test_gradients_do_not_depend_on_the_batch(soft) -> None:
    image, model, K, weights, _ = problems(5, seed=2)
    image[3] = 0.0  # a hopeless neighbour
    ransac = RansacPnp(soft_selection=soft)

    def gradients(rows: slice) -> list[Tensor]:
        leaves = [x[rows].clone().requires_grad_() for x in (image, model, K, weights)]
        result = ransac(PnpProblem(*leaves[:3], weights=leaves[3]))
        value = scaled(result.T_camera_from_model).square().sum()
        if result.candidates is not None:
            T = result.candidates.T_camera_from_model
            value = value + result.candidates.expected(scaled(T).square().sum((-1, -2))).sum()
        return list(torch.autograd.grad(value, leaves))

    together = gradients(slice(None))
    assert all(torch.isfinite(g).all() for g in together)
    for b in range(5):
        for alone, many in zip(gradients(slice(b, b + 1)), together, strict=True):
            torch.testing.assert_close(alone[0], many[b], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("solver", ["epnp", "p3p"])
@pytest.mark.parametrize("mode", ["implicit", "unrolled"])
@pytest.mark.parametrize(
    "case", ["identity", "half_turn", "coplanar", "all_inliers", "four_inliers", "collinear", "no_points"]
)
def test_gradients_are_finite_at_hard_cases(case: str, mode: str, solver: str, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(3)
    model = torch.rand(1, 20, 3, generator=generator, dtype=torch.float64) * 100 - 50
    R = torch.eye(3, dtype=torch.float64)
    if case == "half_turn":
        R = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    if case == "coplanar":
        model[..., 2] = 0.0
    if case == "collinear":
        model = model[:, :1] * torch.linspace(-1, 1, 20, dtype=torch.float64)[None, :, None]
    T = make_transform(R, torch.tensor([3.0, -5.0, 300.0], dtype=torch.float64))[None]
    K = torch.tensor([[[600.0, 0, 210], [0, 600.0, 210], [0, 0, 1]]], dtype=torch.float64)
    camera = model @ R.T + T[:, None, :3, 3]
    image = (camera @ K.mT)[..., :2] / camera[..., 2:]
    if case != "all_inliers":
        image = image + torch.randn(image.shape, generator=generator, dtype=torch.float64)
    valid = torch.full((1, 20), case != "no_points")
    if case == "four_inliers":
        valid[:, 4:] = False
    inputs = [x.to(dtype).requires_grad_() for x in (image, model, K)]
    ransac = RansacPnp(
        solver,
        min_inliers=4,
        threshold=5.0,
        polish=LevenbergMarquardtPnp(differentiation=mode),
        soft_selection=SoftInlierSelection(8),
    )
    result = ransac(PnpProblem(*inputs, valid))
    losses = result.candidates.T_camera_from_model[..., :3, :].square().sum((-1, -2))
    value = result.T_camera_from_model[:, :3].square().sum() + result.candidates.expected(losses).sum()
    gradients = torch.autograd.grad(value, inputs, allow_unused=True)
    for gradient in gradients:
        assert gradient is None or torch.isfinite(gradient).all()
    assert bool(result.success) == (case not in ("collinear", "no_points"))
    if result.success and not (case == "all_inliers" and mode == "unrolled"):  # an exact fit takes no step
        assert gradients[0].abs().max() > 0


def test_without_polish_there_is_the_gradient_of_a_newton_step() -> None:
    image, model, K, _, _ = problems(2, noise=0.0)
    leaf = image.requires_grad_()
    result = RansacPnp(polish_rounds=0)(PnpProblem(leaf, model, K))
    (gradient,) = torch.autograd.grad(scaled(result.T_camera_from_model).square().sum(), leaf)
    # The data fit exactly, so the sample's pose is the optimum on all inliers.
    polished = RansacPnp(polish=precise())(PnpProblem(leaf, model, K))
    assert torch.equal(polished.inliers, result.inliers)
    (expected,) = torch.autograd.grad(scaled(polished.T_camera_from_model).square().sum(), leaf)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-7)


def test_weights() -> None:
    image, model, K, *_ = problems(3, outliers=0.0, noise=0.5)
    shifted = image.clone()
    shifted[:, ::2] += 4.0
    trust = torch.ones(3, 40, dtype=torch.float64)
    trust[:, ::2] = 1e-6
    right = RansacPnp()(PnpProblem(image, model, K)).T_camera_from_model
    plain = (
        (RansacPnp()(PnpProblem(shifted, model, K)).T_camera_from_model - right)[:, :3].flatten(1).norm(dim=1)
    )
    weighted = RansacPnp()(PnpProblem(shifted, model, K, weights=trust)).T_camera_from_model
    assert ((weighted - right)[:, :3].flatten(1).norm(dim=1) < 0.5 * plain).all()
    # A weight of zero, or one that is no number, is as good as absence.
    trust[:, ::4], trust[:, 2::4] = 0.0, torch.nan
    valid = torch.ones(3, 40, dtype=torch.bool)
    valid[:, ::2] = False
    without = RansacPnp()(PnpProblem(shifted, model, K, valid))
    got = RansacPnp()(PnpProblem(shifted, model, K, weights=trust))
    assert torch.equal(got.inliers, without.inliers)
    torch.testing.assert_close(got.T_camera_from_model, without.T_camera_from_model, rtol=1e-6, atol=1e-6)
    ones = RansacPnp()(PnpProblem(image, model, K, weights=torch.ones(3, 40, dtype=torch.float64)))
    assert torch.equal(ones.T_camera_from_model, right)
    with pytest.raises(ValueError, match=r"weights must have shape \(3, 40\), got \(3, 39\)"):
        RansacPnp()(PnpProblem(image, model, K, weights=trust[:, :39]))


def test_candidates_are_a_distribution_around_the_hard_choice() -> None:
    image, model, K, _, _ = problems(4, outliers=0.5)
    image[3] = torch.nan
    soft = RansacPnp(soft_selection=SoftInlierSelection(8))(PnpProblem(image, model, K))
    hard = RansacPnp()(PnpProblem(image, model, K))
    assert hard.candidates is None
    torch.testing.assert_close(soft.T_camera_from_model, hard.T_camera_from_model, rtol=1e-9, atol=1e-9)
    candidates = soft.candidates
    assert candidates.T_camera_from_model.shape == (4, 8, 4, 4)
    assert torch.isfinite(candidates.T_camera_from_model).all()
    torch.testing.assert_close(
        candidates.probability.sum(1), torch.tensor([1.0, 1, 1, 0], dtype=torch.float64)
    )
    assert candidates.valid.tolist()[3] == [False] * 8
    assert torch.equal(candidates.T_camera_from_model[:3, 0], soft.T_camera_from_model[:3])
    # The soft count is close to the hard one, and a sharp one equals it.
    assert ((candidates.score[:3, 0] - soft.num_inliers[:3]).abs() < 6).all()
    sharp = RansacPnp(soft_selection=SoftInlierSelection(8, sharpness=1e6))(PnpProblem(image, model, K))
    torch.testing.assert_close(sharp.candidates.score[:3, 0], soft.num_inliers[:3].double())
    # A low temperature puts all trust in the best.
    cold = RansacPnp(soft_selection=SoftInlierSelection(8, temperature=1e-3))(
        PnpProblem(image, model, K)
    ).candidates
    best = cold.score.masked_fill(~cold.valid, -1).argmax(1)
    # Candidates may coincide after the polish and then share the probability.
    same = (cold.score - cold.score.gather(1, best[:, None])).abs() < 1e-6
    torch.testing.assert_close((cold.probability * same).sum(1)[:3], torch.ones(3, dtype=torch.float64))


def test_expected_loss_is_differentiable_in_the_choice() -> None:
    """Few points and wild samples, so that candidates differ; all inputs, outliers included, have a gradient."""
    image, model, K, _, _ = problems(2, 12, outliers=0.5, noise=4.0, seed=5)
    ransac = RansacPnp(
        min_inliers=4, polish=precise(), polish_rounds=1, soft_selection=SoftInlierSelection(6, 0.2, 2.0)
    )
    truth = ransac(PnpProblem(image, model, K)).T_camera_from_model.detach()
    generator = torch.Generator().manual_seed(0)

    def expected(image: Tensor) -> Tensor:
        candidates = ransac(PnpProblem(image, model, K)).candidates
        T = candidates.T_camera_from_model
        losses = (scaled(T) - scaled(truth)[:, None]).square().sum((-1, -2))
        return candidates.expected(losses)

    leaf = image.clone().requires_grad_()
    candidates = ransac(PnpProblem(image, model, K)).candidates
    assert (candidates.probability > 0.01).sum() > 4
    value = expected(leaf)
    assert (value > 1e-6).all()
    (gradient,) = torch.autograd.grad(value.sum(), leaf)
    # Outliers of the best pose, too, unless they are far from every candidate.
    outliers = ~ransac(PnpProblem(image, model, K)).inliers
    assert (gradient.abs().sum(-1)[outliers] > 1e-6).any()
    for _ in range(3):
        direction = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        numeric = (expected(image + 1e-4 * direction) - expected(image - 1e-4 * direction)).sum() / 2e-4
        assert (gradient * direction).sum().item() == pytest.approx(numeric.item(), rel=2e-2)


def test_soft_choice() -> None:
    T = torch.eye(4).expand(2, 3, 4, 4)
    score = torch.tensor([[4.0, 2.0, 9.0], [1.0, 2.0, 3.0]], requires_grad=True)
    valid = torch.tensor([[True, True, False], [False, False, False]])
    choice = choose_softly(T, score, valid, temperature=2.0)
    torch.testing.assert_close(choice.probability[0], torch.tensor([0.7310586, 0.2689414, 0.0]))
    assert (choice.probability[1] == 0).all()
    losses = torch.tensor([[1.0, 3.0, torch.nan], [torch.inf, 0.0, 1.0]])
    value = choice.expected(losses)
    torch.testing.assert_close(value, torch.tensor([0.7310586 + 3 * 0.2689414, 0.0]))
    (gradient,) = torch.autograd.grad(value.sum(), score)
    # d/ds of p_1 + 3 p_2 with p_1 = σ((s_1 − s_2) / 2).
    torch.testing.assert_close(gradient[0], torch.tensor([-0.1966119, 0.1966119, 0.0]))
    assert (gradient[1] == 0).all()


def test_bad_arguments() -> None:
    for arguments, message in [
        ({"num_candidates": 0}, "num_candidates must be at least 1, got 0"),
        ({"sharpness": 0.0}, "sharpness and temperature must be positive, got 0.0 and 10.0"),
        ({"temperature": -1.0}, "sharpness and temperature must be positive, got 0.5 and -1.0"),
    ]:
        with pytest.raises(ValueError, match=message):
            SoftInlierSelection(**arguments)

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry.transforms import make_transform, rotation_angle, se3_exp, transform_points
from foundpose.optimization import Huber, NormalEquations, levenberg_marquardt


def alignment(points_b: Tensor, points_a: Tensor, unit: float = 1.0):
    """Normal equations of ‖T x_a − x_b‖², anisotropic so that the minimum has no closed form."""
    scale = torch.tensor([1.0, 2.0, 0.5], dtype=points_a.dtype) / unit

    def evaluate(T: Tensor) -> NormalEquations:
        moved = transform_points(T, points_a)
        residual = (moved - points_b) * scale
        eye = torch.eye(3, dtype=T.dtype).expand(*moved.shape, 3)
        by_rotation = -torch.linalg.cross(eye, moved.unsqueeze(-2), dim=-1)
        J = torch.cat([eye, by_rotation], dim=-1) * scale[:, None]
        J, r = J.flatten(1, 2), residual.flatten(1, 2)
        return NormalEquations(0.5 * r.square().sum(-1), J.mT @ J, (J.mT @ r.unsqueeze(-1)).squeeze(-1))

    return evaluate


def problems(count: int, seed: int = 0, noise: float = 0.2) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points_a = torch.randn(count, 12, 3, generator=generator, dtype=torch.float64)
    twist = torch.randn(count, 6, generator=generator, dtype=torch.float64) * 0.6
    T = se3_exp(twist).detach()
    error = torch.randn(count, 12, 3, generator=generator, dtype=torch.float64) * noise
    return transform_points(T, points_a) + error, points_a, T


def test_reaches_scipys_minimum() -> None:
    points_b, points_a, _ = problems(5)
    start = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    result = levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=50)
    assert result.converged.all()
    assert not result.failed.any()
    for b in range(5):
        a, target, scale = points_a[b].numpy(), points_b[b].numpy(), np.array([1.0, 2.0, 0.5])

        def residuals(x: np.ndarray, a=a, target=target, scale=scale) -> np.ndarray:
            return (((a @ Rotation.from_rotvec(x[3:]).as_matrix().T + x[:3]) - target) * scale).ravel()

        reference = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert result.cost[b].item() == pytest.approx(reference.cost, rel=1e-10)
        R = torch.from_numpy(Rotation.from_rotvec(reference.x[3:]).as_matrix())
        assert rotation_angle(result.T[b, :3, :3], R) < 1e-6
        np.testing.assert_allclose(result.T[b, :3, 3].numpy(), reference.x[:3], atol=1e-6)


def test_gradient_vanishes_and_costs_are_consistent() -> None:
    points_b, points_a, _ = problems(4, seed=1)
    evaluate = alignment(points_b, points_a)
    start = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    result = levenberg_marquardt(evaluate, start, max_iterations=50)
    at_optimum = evaluate(result.T)
    assert at_optimum.g.abs().max() < 1e-6
    torch.testing.assert_close(at_optimum.cost, result.cost, rtol=0, atol=0)
    torch.testing.assert_close(at_optimum.H, result.H, rtol=0, atol=0)
    torch.testing.assert_close(evaluate(start).cost, result.initial_cost, rtol=0, atol=0)


def test_does_not_depend_on_the_unit_of_length() -> None:
    points_b, points_a, _ = problems(4, seed=2)
    start = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    metres = levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=4)
    big = levenberg_marquardt(
        alignment(1000 * points_b, 1000 * points_a, unit=1000.0), start, max_iterations=4
    )
    torch.testing.assert_close(big.T[:, :3, :3], metres.T[:, :3, :3], rtol=0, atol=1e-9)
    torch.testing.assert_close(big.T[:, :3, 3] / 1000, metres.T[:, :3, 3], rtol=0, atol=1e-9)


def test_finished_samples_do_not_move_and_neighbours_do_not_matter() -> None:
    points_b, points_a, _ = problems(6, seed=3)
    start = torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)
    # Samples 0 to 2 begin at their optimum and finish at once; the others need many more iterations.
    first = levenberg_marquardt(alignment(points_b[:3], points_a[:3]), start[:3], max_iterations=50)
    start[:3] = first.T
    together = levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=50, chunk=1)
    assert (together.iterations[:3] <= 1).all()
    assert (together.iterations[3:] > 3).all()
    fewer = levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=2)
    assert torch.equal(fewer.T[:3], together.T[:3])
    for b in range(6):
        alone = levenberg_marquardt(
            alignment(points_b[b : b + 1], points_a[b : b + 1]), start[b : b + 1], max_iterations=50
        )
        torch.testing.assert_close(alone.T[0], together.T[b], rtol=0, atol=1e-12)
        assert alone.iterations[0] == together.iterations[b]


def test_bad_samples_are_flagged_and_leave_the_others_alone() -> None:
    points_b, points_a, _ = problems(3, seed=4)
    start = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    clean = levenberg_marquardt(alignment(points_b, points_a), start)
    points_b[1] = torch.nan
    result = levenberg_marquardt(alignment(points_b, points_a), start)
    assert result.failed.tolist() == [False, True, False]
    assert torch.equal(result.T[1], start[1])
    torch.testing.assert_close(result.T[[0, 2]], clean.T[[0, 2]], rtol=0, atol=0)


def test_cost_never_rises_from_bad_starts() -> None:
    points_b, points_a, _ = problems(50, seed=5)
    generator = torch.Generator().manual_seed(6)
    start = se3_exp(3.0 * torch.randn(50, 6, generator=generator, dtype=torch.float64)).detach()
    for iterations in (1, 3, 30):
        result = levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=iterations)
        assert (result.cost <= result.initial_cost).all()
        assert torch.isfinite(result.T).all()


def test_float32() -> None:
    points_b, points_a, _ = problems(4, seed=7)
    start = torch.eye(4).repeat(4, 1, 1)

    def evaluate(T: Tensor) -> NormalEquations:
        return NormalEquations(*(x.float() for x in alignment(points_b, points_a)(T.double())))

    single = levenberg_marquardt(evaluate, start, max_iterations=30)
    double = levenberg_marquardt(alignment(points_b, points_a), start.double(), max_iterations=30)
    assert single.converged.all()
    torch.testing.assert_close(single.T.double(), double.T, rtol=0, atol=2e-4)


def test_gradient_through_the_steps_equals_that_of_the_optimum() -> None:
    # Unrolled Gauss-Newton steps give the optimum's gradient where the residuals are small.
    points_b, points_a, _ = problems(1, seed=8, noise=0.01)
    start = torch.eye(4, dtype=torch.float64)[None]

    def optimum(points_b: Tensor) -> Tensor:
        return levenberg_marquardt(alignment(points_b, points_a), start, max_iterations=30).T

    assert torch.autograd.gradcheck(optimum, (points_b.requires_grad_(),), atol=1e-4, rtol=1e-3)


def test_plain_tensors_start_no_graph() -> None:
    points_b, points_a, _ = problems(2)
    result = levenberg_marquardt(alignment(points_b, points_a), torch.eye(4).double().repeat(2, 1, 1))
    assert not any(x.requires_grad for x in result)


def test_bad_arguments() -> None:
    evaluate = alignment(*problems(1)[:2])
    with pytest.raises(ValueError, match=r"T must have shape \(B, 4, 4\), got \(4, 4\)"):
        levenberg_marquardt(evaluate, torch.eye(4))
    with pytest.raises(ValueError, match="got -1"):
        levenberg_marquardt(evaluate, make_transform(torch.eye(3), torch.zeros(3))[None], max_iterations=-1)


def test_huber_matches_scipy() -> None:
    generator = torch.Generator().manual_seed(9)
    data = torch.randn(200, generator=generator, dtype=torch.float64)
    data[:40] += 20.0
    loss = Huber(1.5)

    def total(x: np.ndarray) -> float:
        return 0.5 * loss((data - float(x[0])).square())[0].sum().item()

    ours = minimize(total, [0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).x[0]
    reference = least_squares(lambda x: data.numpy() - x[0], [0.0], loss="huber", f_scale=1.5, xtol=1e-14)
    assert ours == pytest.approx(reference.x[0], abs=1e-5)
    assert total(np.array([ours])) == pytest.approx(reference.cost, rel=1e-9)


def test_huber_derivative_and_limits() -> None:
    loss = Huber(2.0)
    squared = torch.tensor([0.0, 1.0, 3.9, 4.1, 400.0], dtype=torch.float64, requires_grad=True)
    rho, slope = loss(squared)
    (numeric,) = torch.autograd.grad(rho.sum(), squared)
    torch.testing.assert_close(slope, numeric)
    assert rho[0] == 0
    assert slope[0] == 1
    with pytest.raises(ValueError, match="scale must be positive, got 0"):
        Huber(0.0)

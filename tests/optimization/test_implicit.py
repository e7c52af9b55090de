import pytest
import torch
from torch import Tensor

from foundpose.geometry.transforms import se3_exp, transform_points
from foundpose.optimization import (
    BarronLoss,
    NormalEquations,
    attach_implicit_gradient,
    levenberg_marquardt,
    optimise_pose,
)
from foundpose.optimization.implicit import second_derivative
from tests.optimization.test_levenberg_marquardt import alignment, problems


def optimum(points_b: Tensor, points_a: Tensor, differentiation: str = "implicit") -> Tensor:
    start = torch.eye(4, dtype=points_b.dtype).repeat(len(points_b), 1, 1)
    result = optimise_pose(
        alignment(points_b, points_a),
        start,
        differentiation=differentiation,
        max_iterations=100,
        tolerance=0.0,
    )
    return result.T[:, :3]


def test_gradcheck_at_large_residuals() -> None:
    # Residuals of half the object's size: the Gauss-Newton matrix would be far from the second derivative.
    points_b, points_a, _ = problems(1, seed=7, noise=0.5)
    inputs = (points_b[:, :4].clone().requires_grad_(), points_a[:, :4].clone().requires_grad_())
    assert torch.autograd.gradcheck(optimum, inputs, eps=1e-4, atol=1e-4, rtol=1e-3)


def test_implicit_and_unrolled_agree() -> None:
    points_b, points_a, _ = problems(3, seed=4, noise=0.3)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    gradients = []
    for differentiation in ("implicit", "unrolled"):
        leaves = [x.clone().requires_grad_() for x in (points_b, points_a)]
        value = (optimum(*leaves, differentiation) * direction).sum()
        gradients.append(torch.autograd.grad(value, leaves))
    for implicit, unrolled in zip(*gradients, strict=True):
        torch.testing.assert_close(implicit, unrolled, rtol=1e-5, atol=1e-7)


def test_values_are_those_of_the_optimisation() -> None:
    points_b, points_a, _ = problems(3, seed=5)
    start = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    plain = levenberg_marquardt(alignment(points_b, points_a), start)
    attached = optimise_pose(alignment(points_b.requires_grad_(), points_a), start)
    assert torch.equal(plain.T, attached.T)
    assert torch.equal(plain.cost, attached.cost)
    assert attached.T.requires_grad
    with torch.no_grad():
        assert not optimise_pose(alignment(points_b, points_a), start).T.requires_grad


def test_gradient_of_the_cost_is_that_of_the_minimum() -> None:
    points_b, points_a, _ = problems(2, seed=6, noise=0.4)

    def cost(points_b: Tensor) -> Tensor:
        start = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        evaluate = alignment(points_b, points_a)
        return optimise_pose(evaluate, start, max_iterations=60, tolerance=0.0).cost

    assert torch.autograd.gradcheck(cost, (points_b.requires_grad_(),), eps=1e-5, atol=1e-7, fast_mode=True)


def test_second_derivative_against_finite_differences() -> None:
    points_b, points_a, T = problems(2, seed=7, noise=0.5)
    evaluate = alignment(points_b, points_a)
    T = levenberg_marquardt(evaluate, T, max_iterations=60, tolerance=0.0).T
    A = second_derivative(evaluate, T)
    step = 1e-4
    numeric = torch.zeros_like(A)
    for i in range(6):
        for j in range(6):
            values = []
            for a in (1, -1):
                for b in (1, -1):
                    twist = torch.zeros(2, 6, dtype=torch.float64)
                    twist[:, i] += a * step
                    twist[:, j] += b * step
                    values.append(evaluate(se3_exp(twist) @ T).cost)
            numeric[:, i, j] = (values[0] - values[1] - values[2] + values[3]) / (4 * step**2)
    torch.testing.assert_close(A, numeric, rtol=1e-4, atol=1e-4)


def test_an_undetermined_sample_has_no_gradient_and_disturbs_nobody() -> None:
    points_b, points_a, _ = problems(3, seed=8)
    collinear = points_a.clone()
    collinear[1] = torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None] * torch.tensor(
        [1.0, 2.0, 3.0], dtype=torch.float64
    )
    leaf = points_b.clone().requires_grad_()
    start = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    T = levenberg_marquardt(alignment(points_b, collinear), start).T
    pose = attach_implicit_gradient(alignment(leaf, collinear), T)
    assert pose.regular.tolist() == [True, False, True]
    (together,) = torch.autograd.grad(pose.T[:, :3].square().sum(), leaf)
    assert torch.isfinite(together).all()
    assert (together[1] == 0).all()
    for b in (0, 2):
        alone_leaf = points_b[b : b + 1].clone().requires_grad_()
        alone = attach_implicit_gradient(alignment(alone_leaf, collinear[b : b + 1]), T[b : b + 1])
        (gradient,) = torch.autograd.grad(alone.T[:, :3].square().sum(), alone_leaf)
        torch.testing.assert_close(gradient[0], together[b], rtol=1e-12, atol=1e-14)


def test_a_second_derivative_is_refused() -> None:
    points_b, points_a, _ = problems(1, seed=9)
    points_b.requires_grad_()
    T = optimum(points_b, points_a)
    (gradient,) = torch.autograd.grad(T.square().sum(), points_b, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_an_unknown_mode() -> None:
    points_b, points_a, _ = problems(1)
    with pytest.raises(ValueError, match="'implicit' or 'unrolled', got 'exact'"):
        optimum(points_b, points_a, "exact")


def robust_alignment(points_b: Tensor, points_a: Tensor, loss: BarronLoss):
    def evaluate(T: Tensor) -> NormalEquations:
        moved = transform_points(T, points_a)
        residual = moved - points_b
        rho, slope = loss(residual.square().sum(-1))
        eye = torch.eye(3, dtype=T.dtype).expand(*moved.shape, 3)
        J = torch.cat([eye, -torch.linalg.cross(eye, moved.unsqueeze(-2), dim=-1)], dim=-1)
        weighted = (J * slope[..., None, None]).flatten(1, 2)
        r = residual.flatten(1, 2).unsqueeze(-1)
        return NormalEquations(
            0.5 * rho.sum(-1), weighted.mT @ J.flatten(1, 2), (weighted.mT @ r).squeeze(-1)
        )

    return evaluate


def test_gradient_of_the_losss_parameters() -> None:
    points_b, points_a, T = problems(2, seed=10, noise=0.1)
    points_b[:, 0] += 2.0  # an outlier, so that the loss's shape matters
    loss = BarronLoss(-1.0, 0.3, learnable=True).double()

    def run(alpha: Tensor, log_scale: Tensor) -> Tensor:
        loss.alpha.data, loss.log_scale.data = alpha.detach(), log_scale.detach()

        def evaluate(pose: Tensor) -> NormalEquations:
            values = {"alpha": alpha, "log_scale": log_scale}

            def call(squared: Tensor) -> tuple[Tensor, Tensor]:
                return torch.func.functional_call(loss, values, (squared,))

            return robust_alignment(points_b, points_a, call)(pose)

        return optimise_pose(evaluate, T, max_iterations=100, tolerance=0.0).T[:, :3]

    inputs = [x.detach().clone().requires_grad_() for x in (loss.alpha, loss.log_scale)]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-5, atol=1e-6)
    assert all(g.abs() > 1e-6 for g in torch.autograd.grad(run(*inputs).sum(), inputs))

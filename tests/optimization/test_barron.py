import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foundpose.optimization import BarronLoss

X = torch.tensor([0.0, 1e-6, 1e-3, 0.1, 0.5, 1.0, 3.0, 30.0, 1e4], dtype=torch.float64)

# Barron, CVPR 2019, Eq. 13: the value for the residual x, c = 1 here.
CLOSED_FORMS = {
    2.0: lambda x: 0.5 * x**2,
    1.0: lambda x: torch.sqrt(x**2 + 1) - 1,
    0.0: lambda x: torch.log1p(0.5 * x**2),
    -2.0: lambda x: 2 * x**2 / (x**2 + 4),
    -math.inf: lambda x: -torch.expm1(-0.5 * x**2),
}


@pytest.mark.parametrize("alpha", CLOSED_FORMS)
@pytest.mark.parametrize("scale", [0.5, 7.0])
def test_special_cases(alpha: float, scale: float) -> None:
    loss = BarronLoss(alpha, scale).double()
    loss.log_scale.fill_(math.log(scale))
    expected = CLOSED_FORMS[alpha](X)
    # Beyond 1 / sqrt(eps) the limit stands in for −∞.
    rtol = 1e-6 if alpha == -math.inf else 1e-12
    torch.testing.assert_close(loss.value(X * scale), expected, rtol=rtol, atol=1e-15)
    rho, weight = loss((X * scale).square())
    torch.testing.assert_close(rho, 2 * scale**2 * expected, rtol=rtol, atol=1e-13)
    assert weight[0] == 1


@pytest.mark.parametrize("alpha", [3.0, 2.0, 1.7, 1.0, 1e-3, 1e-9, 0.0, -1e-9, -2.0, -5.0, -100.0, -math.inf])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_general_formula_and_derivative(alpha: float, dtype: torch.dtype) -> None:
    loss = BarronLoss(alpha, 0.5).to(dtype)
    x = torch.linspace(-4, 4, 81, dtype=dtype, requires_grad=True)
    value = loss.value(x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    tolerance = {"rtol": 2e-5, "atol": 2e-6} if dtype == torch.float32 else {"rtol": 1e-7, "atol": 1e-9}
    torch.testing.assert_close(loss.derivative(x).detach(), slope, **tolerance)
    torch.testing.assert_close((loss.weight(x) * x).detach(), slope, **tolerance)
    if abs(alpha) > 0.01 and alpha != 2 and math.isfinite(alpha):
        b = abs(alpha - 2)
        expected = b / alpha * (((x.double() / 0.5) ** 2 / b + 1) ** (alpha / 2) - 1)
        torch.testing.assert_close(value.double(), expected, **tolerance)


@pytest.mark.parametrize("alpha", [2.5, 1.3, 1.0, 0.3, 0.01, 0.0, -0.01, -2.0, -5.0, -40.0])
def test_gradcheck(alpha: float) -> None:
    loss = BarronLoss(alpha, 0.5, learnable=True).double()
    squared = torch.tensor([0.0, 1e-4, 0.2, 1.0, 9.0, 400.0], dtype=torch.float64) + 1e-3

    def run(squared, alpha, log_scale):
        return torch.func.functional_call(loss, {"alpha": alpha, "log_scale": log_scale}, (squared,))

    inputs = [x.detach().clone().requires_grad_() for x in (squared, loss.alpha, loss.log_scale)]
    assert torch.autograd.gradcheck(run, inputs, atol=1e-6)


@given(st.floats(-50, 4), st.floats(0.01, 100), st.floats(0, 1e6, allow_subnormal=False))
@settings(max_examples=200, deadline=None)
def test_grows_with_the_residual_and_falls_with_alpha(alpha: float, scale: float, squared: float) -> None:
    s = torch.tensor([squared, squared * 1.5 + 1e-6], dtype=torch.float64)
    rho, weight = BarronLoss(alpha, scale).double()(s)
    assert torch.isfinite(weight).all()
    assert rho[1] >= rho[0] * (1 - 1e-12) >= 0  # at the ceiling only rounding is left
    smaller = BarronLoss(alpha - 0.5, scale).double()(s)[0]
    assert (smaller <= rho * (1 + 1e-6)).all()


def test_the_ceiling() -> None:
    far = torch.tensor(1e12, dtype=torch.float64)
    for alpha in (-0.5, -2.0, -5.0, -math.inf):
        loss = BarronLoss(alpha, 0.5).double()
        assert float(loss(far)[0]) == pytest.approx(float(loss.ceiling), rel=2e-3)
    assert float(BarronLoss(-5.0, 0.5).ceiling) == pytest.approx(2 * 0.25 * 7 / 5)
    assert torch.isinf(BarronLoss(0.0, 0.5).ceiling)
    assert torch.isinf(BarronLoss(1.0, 0.5).ceiling)


def test_parameters_and_state() -> None:
    assert not list(BarronLoss().parameters())
    loss = BarronLoss(-2.0, 3.0, learnable=True)
    assert {name for name, _ in loss.named_parameters()} == {"alpha", "log_scale"}
    other = BarronLoss()
    other.load_state_dict(loss.state_dict())
    assert float(other.scale) == pytest.approx(3.0)
    assert "alpha=-2, scale=3" in repr(loss)
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="scale must be positive"):
            BarronLoss(scale=bad)
    with pytest.raises(ValueError, match="alpha must be a number"):
        BarronLoss(alpha=math.nan)


@pytest.mark.parametrize("alpha", [-1.0, -2.0, -5.0, -8.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_whole_negative_shapes_equal_the_general_formula(alpha: float, dtype: torch.dtype) -> None:
    squared = torch.cat([torch.zeros(1), torch.logspace(-12, 8, 200)]).to(dtype)
    squared.requires_grad_()
    fast, general = BarronLoss(alpha, 0.7), BarronLoss(alpha, 0.7, learnable=True)
    assert fast.fixed_alpha == alpha
    assert general.fixed_alpha is None
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    for ours, theirs in zip(fast(squared), general(squared), strict=True):
        # Relative, also of the smallest residuals.
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=0.0)
        slopes = [torch.autograd.grad(x.sum(), squared, retain_graph=True)[0] for x in (ours, theirs)]
        torch.testing.assert_close(*slopes, rtol=10 * tolerance, atol=10 * torch.finfo(dtype).eps)


def test_a_loaded_shape_is_the_one_used() -> None:
    loss = BarronLoss(-5.0, 0.5)
    loss.load_state_dict(BarronLoss(-1.5, 0.5).state_dict())
    assert loss.fixed_alpha == -1.5
    x = torch.linspace(0.0, 3.0, 7)
    torch.testing.assert_close(loss(x)[0], BarronLoss(-1.5, 0.5)(x)[0])

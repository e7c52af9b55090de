"""The general and adaptive robust loss."""

from typing import Any

import torch
from torch import Tensor, nn

# Products beat exponentials up to about this exponent.
_LARGEST_POWER = 8


class BarronLoss(nn.Module):
    """Barron's loss: one family from least squares (α = 2) over Charbonnier (1), Cauchy (0) and Geman-McClure (−2)
    to Welsch (−∞).

    In Barron's notation, ``value(x) = |α − 2| / α · (((x / c)² / |α − 2| + 1)^(α / 2) − 1)`` with its limits at
    α = 0, 2 and −∞. Called on squared residuals it is a :class:`RobustLoss`, ``ρ(x²) = 2 c² value(x)``: the same
    minimiser, scaled so that small residuals count as in least squares.

    Args:
        alpha: shape α, any number or −inf or inf; the smaller, the less outliers count.
        scale: c, residual at which the loss leaves the quadratic, in the residual's unit.
        learnable: make α and c (by its logarithm) parameters. Minimising this loss alone over them is pointless
            (smaller α is always cheaper); it is meant for an outer loss on what the optimisation returns.

    Attributes:
        fixed_alpha: α as a number on the host, or None if it is learned.

    Raises:
        ValueError: ``scale`` is not positive, or ``alpha`` is NaN.

    Differentiable w.r.t. residuals, α and c, everywhere; the derivative in α grows without bound (logarithmically)
    towards α = 2.

    Source: Barron, "A general and adaptive robust loss function", CVPR 2019; paper, "Featuremetric pose refinement"
    (α = −5, c = 0.5).
    """

    alpha: Tensor
    log_scale: Tensor

    def __init__(self, alpha: float = -5.0, scale: float = 0.5, learnable: bool = False) -> None:
        super().__init__()
        if not scale > 0 or scale == float("inf"):
            raise ValueError(f"scale must be positive and finite, got {scale}")
        if alpha != alpha:
            raise ValueError("alpha must be a number, got NaN")
        shape, log_scale = torch.tensor(float(alpha)), torch.tensor(float(scale)).log()
        self.learnable = learnable
        self.fixed_alpha = None if learnable else float(alpha)
        if learnable:
            self.alpha, self.log_scale = nn.Parameter(shape), nn.Parameter(log_scale)
        else:
            self.register_buffer("alpha", shape)
            self.register_buffer("log_scale", log_scale)

    @property
    def scale(self) -> Tensor:
        """c, a scalar tensor."""
        return self.log_scale.exp()

    @property
    def ceiling(self) -> Tensor:
        """Largest value of ρ, ``2 c² |α − 2| / |α|`` for α < 0 (Welsch: 2 c²); infinite for others."""
        bounded = self.alpha < 0
        alpha = torch.where(bounded, self.alpha, -torch.ones_like(self.alpha))
        ratio = torch.where(torch.isinf(alpha), torch.ones_like(alpha), 1.0 - 2.0 / alpha)
        return torch.where(bounded, 2.0 * self.scale.square() * ratio, torch.inf)

    def forward(self, squared: Tensor) -> tuple[Tensor, Tensor]:
        """ρ and the IRLS weight ρ' of squared residuals.

        Args:
            squared: any shape, not negative, the residual's unit squared.

        Returns:
            ρ, same shape and unit, and its derivative in [0, 1] for α ≤ 2 (1 at zero).
        """
        unit = self.scale.to(squared.dtype).square()
        if self.fixed_alpha is not None and -self.fixed_alpha in range(1, _LARGEST_POWER + 1):
            return _negative_integer(squared, unit, int(-self.fixed_alpha))
        z, eps = squared / unit, torch.finfo(squared.dtype).eps
        # Beyond ±1 / √eps the loss equals its limit to rounding, and b > 0 keeps z / b finite: at α = 2 the value
        # does not depend on b.
        alpha = self.alpha.to(z.dtype).clamp(-(eps**-0.5), eps**-0.5)
        b = (alpha - 2.0).abs().clamp(min=eps)
        u = torch.log1p(z / b)
        # 2 b / α ((z / b + 1)^(α / 2) − 1) = b u · (eʸ − 1) / y with y = α u / 2, smooth through α = 0.
        return unit * b * u * _expm1_ratio(0.5 * alpha * u), torch.exp((0.5 * alpha - 1.0) * u)

    def value(self, residual: Tensor) -> Tensor:
        """Barron's ρ(x, α, c) of residuals of any shape; no unit."""
        return self(residual.square())[0] / (2.0 * self.scale.to(residual.dtype).square())

    def derivative(self, residual: Tensor) -> Tensor:
        """∂ρ(x, α, c) / ∂x of residuals of any shape."""
        return residual * self.weight(residual)

    def weight(self, residual: Tensor) -> Tensor:
        """IRLS weight ``(1 / x) ∂ρ(x, α, c) / ∂x``; 1 / c² at zero."""
        return self(residual.square())[1] / self.scale.to(residual.dtype).square()

    def extra_repr(self) -> str:
        """Settings, for printing; they are part of what a result depends on."""
        alpha, scale = self.alpha.item(), self.scale.item()
        return f"alpha={alpha:g}, scale={scale:g}, learnable={self.learnable}"

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.fixed_alpha = None if self.learnable else float(self.alpha)


def _negative_integer(squared: Tensor, unit: Tensor, power: int) -> tuple[Tensor, Tensor]:
    """ρ and weight for α = −power and c² = unit, by products and one square root: a quarter of the time of the
    general formula, which optimisers evaluate for every channel of every patch in every step."""
    # With r = (x² / (b c²) + 1)^(−1/2), b = power + 2, the weight is r^b and ρ = 2 c² b / power (1 − r^power), which
    # is, exactly, 2 / power x² f(power) with f(p) = r² (1 + f(p − 2)), f(0) = 0 and f(1) = r² / (1 + r).
    r = torch.rsqrt(squared * (1.0 / ((power + 2.0) * unit)) + 1.0)
    r_squared = r * r
    f, weight = (r_squared / (1.0 + r), r) if power % 2 else (r_squared, r_squared)
    for _ in range((power - 1) // 2):
        f = torch.addcmul(r_squared, r_squared, f)
    for _ in range((power + 1) // 2):
        weight = weight * r_squared
    return squared * f * (2.0 / power), weight


def _expm1_ratio(y: Tensor) -> Tensor:
    """(eʸ − 1) / y, smooth at zero."""
    zero = y == 0
    # expm1 is exact enough for the quotient however small y is; at zero itself a polynomial gives the derivatives.
    return torch.where(zero, 1.0 + y * (0.5 + y / 6.0), torch.expm1(y) / torch.where(zero, 1.0, y))

"""Robust losses on squared residuals."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class RobustLoss(Protocol):
    """A loss ρ(s) of the squared residual s with ρ(0) = 0 and ρ'(0) = 1, so that it is s near zero.

    The cost of a set of residuals r is ``½ Σ ρ(r²)``; its Gauss-Newton system is that of ordinary least
    squares with each residual weighted by ρ', the weight of iteratively reweighted least squares (IRLS).
    """

    def __call__(self, squared: Tensor) -> tuple[Tensor, Tensor]:
        """Return ρ and its derivative ρ', both in the shape of ``squared``."""
        ...


@dataclass(frozen=True)
class LeastSquares:
    """No robustness: ρ(s) = s. Differentiable w.r.t. the squared residual."""

    def __call__(self, squared: Tensor) -> tuple[Tensor, Tensor]:
        """Return the squared residuals as they are, and ones."""
        return squared, torch.ones_like(squared)


@dataclass(frozen=True)
class Huber:
    """Huber's loss: quadratic up to ``scale``, linear beyond.

    Args:
        scale: residual where the loss turns linear, in the residual's unit.

    Differentiable w.r.t. the squared residual. Source: Huber, "Robust estimation of a location parameter", 1964.
    """

    scale: float

    def __post_init__(self) -> None:
        if not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")

    def __call__(self, squared: Tensor) -> tuple[Tensor, Tensor]:
        """Return ρ and ρ' of squared residuals of any shape."""
        inside = squared <= self.scale**2
        # The clamp keeps the square root's derivative finite at zero, where the branch is not taken.
        norm = squared.clamp(min=self.scale**2).sqrt()
        rho = torch.where(inside, squared, 2.0 * self.scale * norm - self.scale**2)
        return rho, self.scale / norm

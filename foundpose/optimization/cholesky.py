"""Cholesky factors of small symmetric systems with mixed units."""

from typing import NamedTuple

import torch
from torch import Tensor


class ScaledCholesky(NamedTuple):
    """Cholesky factors of ``A / (root rootᵀ)``, whose condition number is free of units.

    Attributes:
        factor: (B, n, n) lower triangular; identity where not usable.
        root: (B, n), positive.
        usable: (B,) bool, A is finite and positive definite, its smallest pivot above rounding.
    """

    factor: Tensor
    root: Tensor
    usable: Tensor

    def solve(self, b: Tensor) -> Tensor:
        """A⁻¹ b for b (B, n); zero where not usable."""
        b = torch.where(self.usable[:, None], b, torch.zeros_like(b))
        return torch.cholesky_solve((b / self.root).unsqueeze(-1), self.factor).squeeze(-1) / self.root

    def inverse(self) -> Tensor:
        """A⁻¹ (B, n, n); meaningless where not usable."""
        return torch.cholesky_inverse(self.factor) / (self.root[:, :, None] * self.root[:, None, :])


def scaled_cholesky(A: Tensor, diagonal: Tensor) -> ScaledCholesky:
    """Factorise symmetric matrices.

    Args:
        A: (B, n, n).
        diagonal: (B, n) scale of each variable squared, such as A's diagonal; not negative.

    Returns:
        The factors. Not differentiable (constants of a gradient or a covariance).
    """
    A, diagonal = A.detach(), diagonal.detach()
    finite = torch.isfinite(A).all(-1).all(-1) & torch.isfinite(diagonal).all(-1)
    identity = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    A = torch.where(finite[:, None, None], A, identity)
    diagonal = torch.where(finite[:, None], diagonal, torch.ones_like(diagonal))
    limits = torch.finfo(A.dtype)
    root = diagonal.clamp(min=limits.eps * diagonal.amax(-1, keepdim=True) + limits.tiny).sqrt()
    factor, info = torch.linalg.cholesky_ex(A / (root[:, :, None] * root[:, None, :]))
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    usable = finite & (info == 0) & (pivots.amin(-1) > 64.0 * limits.eps * pivots.amax(-1))
    return ScaledCholesky(torch.where(usable[:, None, None], factor, identity), root, usable)

"""Derivatives of what is computed on detached tensors, finite where autograd's are not."""

import torch
from torch import Tensor


def attach_optimum(beta: Tensor, hessian: Tensor, g: Tensor) -> Tensor:
    """Optima with their values unchanged and with the gradient that g = 0 implies (implicit function theorem).

    Args:
        beta: (..., k) optima, detached.
        hessian: (..., k, k) second derivatives of the cost there; not only those of Gauss-Newton.
        g: (..., k) gradient of the cost at the detached optima, with a graph to the data.

    Returns:
        (..., k). Differentiable (once) w.r.t. what ``g`` depends on; directions that do not matter to the cost have
        a gradient of zero.
    """
    rounding = beta.shape[-1] * torch.finfo(beta.dtype).eps
    step = (torch.linalg.pinv(hessian.detach(), rtol=rounding, hermitian=True) @ g.unsqueeze(-1)).squeeze(-1)
    return beta - (step - step.detach())


def eigenbasis(A: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (..., n), ascending, and eigenvectors (..., n, n) of symmetric matrices (..., n, n).

    Differentiable (once) w.r.t. ``A``, by first-order perturbation. Eigenvectors whose eigenvalues agree but for
    rounding do not turn into each other: the gradient is that of the space they span.
    """
    values, V = torch.linalg.eigh(A.detach())
    if not A.requires_grad:
        return values, V
    inner = V.transpose(-1, -2) @ A @ V
    inner = inner - inner.detach()  # zero; only its derivative is wanted
    gap = values.unsqueeze(-2) - values.unsqueeze(-1)
    rounding = A.shape[-1] * torch.finfo(A.dtype).eps * values[..., -1:, None]
    turn = inner / gap.where(gap.abs() > rounding, torch.inf)
    return values + inner.diagonal(dim1=-2, dim2=-1), V + V @ turn


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root; zero, with a derivative of zero, where x is not positive."""
    positive = x > 0
    return torch.where(positive, x, torch.ones_like(x)).sqrt() * positive

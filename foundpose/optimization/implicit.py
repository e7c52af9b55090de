"""Gradients of an optimum by the implicit function theorem."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from foundpose.geometry.transforms import se3_exp
from foundpose.optimization.cholesky import ScaledCholesky, scaled_cholesky
from foundpose.optimization.levenberg_marquardt import (
    LevenbergMarquardtResult,
    NormalEquations,
    levenberg_marquardt,
)

Differentiation = Literal["implicit", "unrolled"]


class ImplicitPose(NamedTuple):
    """Poses with the gradient of an optimum.

    Attributes:
        T: (B, 4, 4), the values that were given.
        cost: (B,) cost there; its gradient is that of the minimum (the pose's own share vanishes).
        regular: (B,) bool, the second derivative is well enough conditioned to be inverted; elsewhere the gradient of
            ``T`` is zero.
    """

    T: Tensor
    cost: Tensor
    regular: Tensor


def attach_implicit_gradient(evaluate: Callable[[Tensor], NormalEquations], T: Tensor) -> ImplicitPose:
    """Give poses that minimise a cost their gradient with respect to everything that the cost depends on.

    At a minimum the cost's gradient g(T, θ) in the left twist vanishes, whatever θ is, hence
    ``dδ / dθ = −(∂g / ∂δ)⁻¹ ∂g / ∂θ``. That takes one evaluation, however many iterations found the minimum, and
    nothing of the iterations is kept. At a pose that is no minimum the result is the derivative of one Newton step.

    ``∂g / ∂δ`` is the exact second derivative, by automatic differentiation of ``g``; where it is not positive
    definite (a pose far from a minimum) the Gauss-Newton matrix stands in.

    Args:
        evaluate: gives the :class:`NormalEquations` of all samples at poses (B, 4, 4), as for
            :func:`levenberg_marquardt`; its g must be differentiable w.r.t. the pose and what shall get a gradient.
        T: (B, 4, 4) minimisers; taken as constants.

    Returns:
        An :class:`ImplicitPose`; without gradient mode, or where nothing requires a gradient, plain constants.

    Differentiable w.r.t. whatever ``evaluate`` closes over, once: a second derivative raises.

    Source: Krantz and Parks, "The implicit function theorem", 2002; for PnP: Chen et al., "End-to-end learnable
    geometric vision by backpropagating PnP optimization", CVPR 2020.
    """
    T = T.detach()
    cost, H, g = evaluate(T)
    if not g.requires_grad:
        return ImplicitPose(T, cost, torch.ones_like(cost, dtype=torch.bool))
    diagonal = H.detach().diagonal(dim1=-2, dim2=-1)
    exact, approximate = (
        scaled_cholesky(second_derivative(evaluate, T), diagonal),
        scaled_cholesky(H, diagonal),
    )
    choose = exact.usable
    system = ScaledCholesky(
        torch.where(choose[:, None, None], exact.factor, approximate.factor),
        torch.where(choose[:, None], exact.root, approximate.root),
        choose | approximate.usable,
    )
    step: Tensor = _NewtonStep.apply(g, *system)
    return ImplicitPose(se3_exp(step) @ T, cost, system.usable)


def second_derivative(evaluate: Callable[[Tensor], NormalEquations], T: Tensor) -> Tensor:
    """Exact second derivative (B, 6, 6) of costs in the left twist at minima (B, 4, 4); a constant."""
    with torch.enable_grad():
        twist = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device, requires_grad=True)
        g = evaluate(se3_exp(twist) @ T.detach()).g
        rows = [torch.autograd.grad(g[:, i].sum(), twist, retain_graph=i < 5)[0] for i in range(6)]
    A = torch.stack(rows, dim=1).detach()
    return 0.5 * (A + A.transpose(-1, -2))


def optimise_pose(
    evaluate: Callable[[Tensor], NormalEquations],
    T: Tensor,
    *,
    differentiation: Differentiation = "implicit",
    max_iterations: int = 20,
    initial_damping: float = 1e-3,
    tolerance: float | None = None,
    floor: float | Tensor = 0.0,
) -> LevenbergMarquardtResult:
    """Run :func:`levenberg_marquardt` with the gradient of the optimum or of the steps.

    Args:
        evaluate: as for :func:`levenberg_marquardt`.
        T: (B, 4, 4) initial poses.
        differentiation: "implicit": gradient at the optimum, memory of one evaluation. "unrolled": through the steps.
        max_iterations, initial_damping, tolerance, floor: as for :func:`levenberg_marquardt`.

    Returns:
        The result. In mode "implicit" ``T`` and ``cost`` have gradients, the initial pose gets none (the optimum does
        not depend on it) and failed samples have none.

    Raises:
        ValueError: an unknown mode or setting.
    """
    check_differentiation(differentiation)
    settings: dict[str, Any] = {
        "max_iterations": max_iterations,
        "initial_damping": initial_damping,
        "tolerance": tolerance,
        "floor": floor,
    }
    if differentiation == "unrolled":
        return levenberg_marquardt(evaluate, T, **settings)
    with torch.no_grad():
        result = levenberg_marquardt(evaluate, T, **settings)
    if not torch.is_grad_enabled():
        return result
    optimum = attach_implicit_gradient(evaluate, result.T)
    failed = result.failed
    return result._replace(
        T=torch.where(failed[:, None, None], result.T, optimum.T),
        cost=torch.where(failed, result.cost, optimum.cost),
        regular=optimum.regular,
    )


def check_differentiation(differentiation: str) -> None:
    """Raise ValueError for an unknown mode."""
    if differentiation not in ("implicit", "unrolled"):
        raise ValueError(f"differentiation must be 'implicit' or 'unrolled', got {differentiation!r}")


class _NewtonStep(torch.autograd.Function):
    """A step of zero whose derivative in g is −A⁻¹, A given by its factors."""

    @staticmethod
    def forward(ctx: Any, g: Tensor, factor: Tensor, root: Tensor, usable: Tensor) -> Tensor:
        ctx.save_for_backward(factor, root, usable)
        return torch.zeros_like(g)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return -ScaledCholesky(*ctx.saved_tensors).solve(grads[0]), None, None, None

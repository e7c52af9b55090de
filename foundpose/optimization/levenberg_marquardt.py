"""Batched Levenberg-Marquardt on SE(3)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import se3_exp


class NormalEquations(NamedTuple):
    """A least-squares problem linearised at a pose, for the left update ``T ← exp(δ) @ T``.

    Attributes:
        cost: (B,) the cost ``½ Σ ρ``; infinite where the pose is not admissible.
        H: (B, 6, 6) Gauss-Newton approximation of the cost's second derivative in δ.
        g: (B, 6) the cost's gradient in δ.
    """

    cost: Tensor
    H: Tensor
    g: Tensor


class LevenbergMarquardtResult(NamedTuple):
    """Outcome of :func:`levenberg_marquardt`.

    Attributes:
        T: (B, 4, 4) optimised poses.
        cost: (B,) cost at ``T``; never above ``initial_cost`` but for rounding.
        initial_cost: (B,) cost at the initial poses.
        iterations: (B,) int64, steps tried for each sample.
        converged: (B,) bool, the predicted decrease fell below the tolerance.
        failed: (B,) bool, the problem cannot be solved: a cost, H or g that is not finite at the initial pose, or
            an H of zeros (no data). Such a pose is returned as it came.
        H: (B, 6, 6) Gauss-Newton matrix at ``T``.
        regular: (B,) bool, set with an implicit gradient: the second derivative could be inverted; elsewhere the
            gradient of ``T`` is zero. All true without one.
    """

    T: Tensor
    cost: Tensor
    initial_cost: Tensor
    iterations: Tensor
    converged: Tensor
    failed: Tensor
    H: Tensor
    regular: Tensor


def levenberg_marquardt(
    evaluate: Callable[[Tensor], NormalEquations],
    T: Tensor,
    *,
    max_iterations: int = 20,
    initial_damping: float = 1e-3,
    tolerance: float | None = None,
    floor: float | Tensor = 0.0,
    chunk: int | None = None,
) -> LevenbergMarquardtResult:
    """Minimise one cost per sample over rigid transformations.

    Each sample has its own damping, which multiplies the diagonal of H (Marquardt), so the steps do not depend
    on the units of length and angle. A step is kept where the cost does not rise; there the damping shrinks
    tenfold, elsewhere it grows tenfold. A sample is finished when the decrease that its linearisation predicts
    is below ``tolerance`` times its cost or below ``floor``; from then on it does not move by a single bit,
    whatever its neighbours do.

    Args:
        evaluate: gives the :class:`NormalEquations` of all samples at poses (B, 4, 4). Sample b of its output
            may depend on sample b of its input only.
        T: (B, 4, 4) initial poses.
        max_iterations: upper limit on the steps tried.
        initial_damping: first damping factor.
        tolerance: relative decrease of the cost that counts as converged; None means four units of rounding.
        floor: decrease of the cost that is mere rounding, a number or (B,); data that fit exactly need it.
        chunk: iterations between two looks at whether all samples are finished (each look waits for the device);
            None means 1 on a CPU, where looking costs nothing, and 5 elsewhere. It has no influence on the result.

    Returns:
        A :class:`LevenbergMarquardtResult`.

    Raises:
        ValueError: ``T`` is not (B, 4, 4) or a setting is out of range.

    Differentiable w.r.t. ``T`` and whatever ``evaluate`` closes over, through the steps taken (unrolled); which
    steps are kept, and the damping factors, count as constants. For the gradient of the optimum itself see
    :func:`~foundpose.optimization.attach_implicit_gradient`.

    Source: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963.
    """
    if T.dim() != 3 or T.shape[-2:] != (4, 4):
        raise ValueError(f"T must have shape (B, 4, 4), got {tuple(T.shape)}")
    if chunk is None:
        chunk = 1 if T.device.type == "cpu" else 5
    if max_iterations < 0 or chunk < 1 or not initial_damping > 0:
        raise ValueError(
            "max_iterations must be at least 0, chunk at least 1 and initial_damping positive, "
            f"got {max_iterations}, {chunk} and {initial_damping}"
        )
    eps = torch.finfo(T.dtype).eps
    relative = 4.0 * eps if tolerance is None else tolerance

    cost, H, g = evaluate(T)
    initial_cost = cost
    damping = torch.full_like(cost.detach(), initial_damping)
    shrink, grow = damping.new_full((), 0.1), damping.new_full((), 10.0)
    iterations = torch.zeros(T.shape[0], dtype=torch.int64, device=T.device)
    failed = ~(_finite(cost, H, g) & (H.diagonal(dim1=-2, dim2=-1).amax(-1) > 0))
    active = ~failed
    # Unit systems stand in for those that cannot be solved, so that no NaN enters the graph; what is accepted below
    # is finite.
    initial_H = H
    identity = torch.eye(6, dtype=H.dtype, device=H.device)
    H = torch.where(failed[:, None, None], identity, H)
    g = torch.where(failed[:, None], 0.0, g)

    for iteration in range(max_iterations):
        if iteration % chunk == 0 and not bool(active.any()):
            break
        step, predicted, solved = _solve(H, g, damping)
        T_new = torch.bmm(se3_exp(step), T)
        cost_new, H_new, g_new = evaluate(T_new)
        # A decrease below rounding may look like a rise, but the step still brings g closer to zero.
        rounding = eps * cost.detach()
        most = torch.where(predicted <= rounding, cost + rounding, cost)
        finished = solved & (predicted <= relative * cost.detach() + floor)
        accepted = active & solved & (cost_new <= most) & _finite(cost_new, H_new, g_new)
        row, matrix = accepted.unsqueeze(-1), accepted[:, None, None]
        T = torch.where(matrix, T_new, T)
        cost = torch.where(accepted, cost_new, cost)
        H = torch.where(matrix, H_new, H)
        g = torch.where(row, g_new, g)

        damping = (damping * torch.where(accepted, shrink, grow)).clamp(1e-10, 1e10)
        iterations = iterations + active
        active = active & ~finished
    converged = ~(active | failed)
    H = torch.where(failed[:, None, None], initial_H, H)
    regular = torch.ones_like(failed)
    return LevenbergMarquardtResult(T, cost, initial_cost, iterations, converged, failed, H, regular)


def _finite(cost: Tensor, H: Tensor, g: Tensor) -> Tensor:
    # A sum is finite only if all its terms are.
    return (cost + (H.sum(-1) + g).sum(-1)).detach().abs() < torch.inf


def _solve(H: Tensor, g: Tensor, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Damped step (B, 6) of finite systems, the decrease that it promises (B,), a constant, and whether it could be
    solved for (B,); it is zero where it could not."""
    diagonal, limits = H.diagonal(dim1=-2, dim2=-1), torch.finfo(H.dtype)
    # Cholesky's factorisation rounds as if the diagonal were ones, so units need no scaling; what has no curvature
    # is damped as if it had as little as the numbers can tell.
    least = (limits.eps * diagonal.amax(-1, keepdim=True)).clamp(min=limits.tiny)
    added = damping.unsqueeze(-1) * torch.maximum(diagonal, least)
    damped = H + torch.diag_embed(added)
    factor, info = torch.linalg.cholesky_ex(damped.detach())
    solved = info == 0
    if torch.is_grad_enabled():
        # Its derivative would be NaN where it fails.
        identity = torch.eye(6, dtype=H.dtype, device=H.device)
        factor = torch.linalg.cholesky_ex(torch.where(solved[:, None, None], damped, identity)).L
    # Two triangular systems take half the time of cholesky_solve.
    half_way = torch.linalg.solve_triangular(factor, g.unsqueeze(-1), upper=False)
    step = torch.linalg.solve_triangular(factor.mT, half_way, upper=True).squeeze(-1)
    step = torch.where(solved.unsqueeze(-1), -step, 0.0)
    # −gᵀ δ − ½ δᵀ H δ, as (H + D) δ = −g with the damping D.
    predicted = 0.5 * (step * (added * step - g)).sum(-1).detach()
    return step, predicted, solved

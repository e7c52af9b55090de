"""Hypotheses from random minimal samples."""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.cameras import pixel_rays
from foundpose.geometry.transforms import transform_points
from foundpose.pnp.epnp import MinimalSolution, solve_epnp_minimal
from foundpose.pnp.p3p import solve_p3p_rays
from foundpose.pnp.scoring import score_poses

SAMPLE_SIZE = 4

SolverName = Literal["epnp", "p3p"]


class Hypotheses(NamedTuple):
    """The best poses that samples gave, best first.

    Attributes:
        T: (B, J, 4, 4); identity where there is none.
        quality: (B, J) as of :func:`score_poses`; −1 where there is none.
        determined: (B,) bool, some sample determined a pose, wherever it put the points.
    """

    T: Tensor
    quality: Tensor
    determined: Tensor


def solve_p3p_minimal(rays: Tensor, points_model: Tensor) -> MinimalSolution:
    """P3P on the first three of four correspondences; the fourth chooses among the roots.

    Args:
        rays: (S, 4, 3) rays in the camera frame with z = 1, finite.
        points_model: (S, 4, 3) mesh units, finite.

    Returns:
        A :class:`MinimalSolution`.
    """
    roots = solve_p3p_rays(rays[:, :3], points_model[:, :3])
    T = roots.T_camera_from_model
    fourth = transform_points(T, points_model[:, None, 3:]).squeeze(-2)  # (S, 4, 3)
    ahead = roots.valid & (fourth[..., 2] > 0)
    plane = fourth[..., :2] / torch.where(ahead, fourth[..., 2], torch.ones_like(fourth[..., 2])).unsqueeze(
        -1
    )
    error = (plane - rays[:, None, 3, :2]).square().sum(-1).masked_fill(~ahead, torch.inf)
    best = error.argmin(dim=1, keepdim=True)
    T = torch.take_along_dim(T, best[..., None, None], dim=1).squeeze(1)
    return MinimalSolution(T, ahead.any(1), roots.degenerate)


# Rays (S, 4, 3) and model points (S, 4, 3) to poses.
_SOLVERS: dict[str, Callable[[Tensor, Tensor], MinimalSolution]] = {
    "epnp": solve_epnp_minimal,
    "p3p": solve_p3p_minimal,
}


def check_solver(solver: str) -> None:
    """Raise ValueError for an unknown minimal solver."""
    if solver not in _SOLVERS:
        raise ValueError(f"solver must be one of {sorted(_SOLVERS)}, got {solver!r}")


def sample_hypotheses(
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    valid: Tensor,
    usable: Tensor,
    draws: Tensor,
    *,
    solver: SolverName,
    threshold: float,
    confidence: float | None,
    chunk: int,
    keep: int = 1,
) -> Hypotheses:
    """Solve and score minimal samples until each problem has had enough.

    Args:
        points_image: (B, N, 2) pixels, finite.
        points_model: (B, N, 3), finite.
        K: (B, 3, 3), invertible.
        valid: (B, N) bool.
        usable: (B,) bool, problems to look at; they have at least four valid correspondences.
        draws: (I, 4) integers in [0, 2³¹), the same for all problems.
        solver: minimal solver.
        threshold: of an inlier, pixels.
        confidence: stop a problem once an all-inlier sample has been drawn with this probability; None never stops.
        chunk: samples solved at once.
        keep: number J of hypotheses to keep.

    Returns:
        The best hypotheses. Not differentiable: give it detached tensors.
    """
    solve = _SOLVERS[solver]
    batch = len(points_image)
    rays = pixel_rays(points_image, K)
    count = valid.sum(-1)
    # Valid correspondences first, so that a rank among the valid ones becomes an index.
    order = torch.argsort((~valid).to(torch.uint8), dim=-1, stable=True)
    best_T = torch.eye(4, dtype=K.dtype, device=K.device).repeat(batch, keep, 1, 1)
    best_quality = K.new_full((batch, keep), -1.0)
    determined = torch.zeros_like(usable)
    problems = usable.nonzero().squeeze(-1)
    for first in range(0, len(draws), chunk):
        if problems.numel() == 0:
            break
        ranks = distinct_ranks(draws[first : first + chunk], count[problems])
        index = torch.take_along_dim(order[problems], ranks.flatten(1), dim=1).unsqueeze(-1)
        pixels, model = points_image[problems], points_model[problems]
        samples = ranks.shape[:2]
        solution = solve(
            torch.take_along_dim(rays[problems], index, dim=1).reshape(-1, SAMPLE_SIZE, 3),
            torch.take_along_dim(model, index, dim=1).reshape(-1, SAMPLE_SIZE, 3),
        )
        T = solution.T_camera_from_model.unflatten(0, samples)
        solved = solution.valid.unflatten(0, samples)
        quality = score_poses(T, pixels, model, K[problems], valid[problems], threshold)
        quality = torch.cat([best_quality[problems], quality.masked_fill(~solved, -1.0)], dim=1)
        # A stable sort: of equally good samples the first, on every device.
        quality, place = quality.sort(dim=1, descending=True, stable=True)
        best_quality[problems] = quality[:, :keep]
        best_T[problems] = torch.take_along_dim(
            torch.cat([best_T[problems], T], dim=1), place[:, :keep, None, None], dim=1
        )
        determined[problems] |= (~solution.degenerate).unflatten(0, samples).any(-1)
        if confidence is not None:
            drawn = first + samples[1]
            ratio = quality[:, 0].clamp(min=0.0).floor() / count[problems]
            missed = drawn * torch.log1p(-ratio.clamp(max=1.0 - 1e-6).pow(SAMPLE_SIZE))
            problems = problems[missed > math.log(1.0 - confidence)]
    missing = best_quality < 0
    best_T = torch.where(missing[..., None, None], torch.eye(4, dtype=K.dtype, device=K.device), best_T)
    return Hypotheses(best_T, best_quality, determined)


def distinct_ranks(draws: Tensor, count: Tensor) -> Tensor:
    """Turn integers into distinct ranks below each problem's count, by exact integer arithmetic.

    Args:
        draws: (I, s) int64 in [0, 2³¹).
        count: (B,) int64, at least s and below 2³².

    Returns:
        (B, I, s) int64 ranks, distinct along the last dimension and uniform over ordered selections.
    """
    picked: list[Tensor] = []
    for k in range(draws.shape[1]):
        rank = (draws[:, k] * (count[:, None] - k)) >> 31
        # Skip the ranks already taken, in ascending order.
        for taken in torch.stack(picked, dim=-1).sort(dim=-1).values.unbind(-1) if picked else ():
            rank = rank + (rank >= taken).to(rank.dtype)
        picked.append(rank)
    return torch.stack(picked, dim=-1)

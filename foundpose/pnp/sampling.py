"""Hypotheses from random minimal samples."""

import math
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.cameras import pixel_rays
from foundpose.pnp.dlt import solve_dlt_minimal
from foundpose.pnp.epnp import solve_epnp_minimal
from foundpose.pnp.p3p import solve_p3p_minimal
from foundpose.pnp.problem import MinimalSolution, PnpProblem
from foundpose.pnp.scoring import score_poses

# A sample of inliers only may still be a poor one, through their noise: this many are drawn whatever the confidence.
_LEAST_SAMPLES = 50

SolverName = Literal["epnp", "p3p", "dlt"]


# Correspondences of a sample, and its solver: rays (S, n, 3) and model points (S, n, 3) to poses.
_SOLVERS: dict[str, tuple[int, Callable[[Tensor, Tensor], MinimalSolution]]] = {
    "epnp": (4, solve_epnp_minimal),
    "p3p": (4, solve_p3p_minimal),
    "dlt": (6, solve_dlt_minimal),
}


class Sampling(NamedTuple):
    """How minimal samples are solved and scored.

    Attributes:
        solver: minimal solver.
        threshold: of an inlier, pixels.
        confidence: a problem's samples count until an all-inlier sample has been drawn with this probability (and 50
            in any case); None means that all count.
        chunk: samples solved at once; None chooses. It has no influence on the result.
        score_points: at most this many correspondences of a problem, evenly spread, score the samples; None: all.
        keep: number J of hypotheses to keep.
    """

    solver: SolverName
    threshold: float
    confidence: float | None = None
    chunk: int | None = None
    score_points: int | None = None
    keep: int = 1


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


def sample_size(solver: str) -> int:
    """How many correspondences a minimal solver takes.

    Raises:
        ValueError: an unknown solver.
    """
    if solver not in _SOLVERS:
        raise ValueError(f"solver must be one of {sorted(_SOLVERS)}, got {solver!r}")
    return _SOLVERS[solver][0]


def sample_hypotheses(
    problem: PnpProblem, usable: Tensor, draws: Tensor, sampling: Sampling, priority: Tensor | None = None
) -> Hypotheses:
    """Solve and score minimal samples until each problem has had enough.

    Args:
        problem: B clean problems.
        usable: (B,) bool, problems to look at; they have at least as many valid correspondences as a sample.
        draws: (I, n) integers in [0, 2³¹), the same for all problems; small ones stand for high priorities.
        sampling: how they are solved and scored.
        priority: (B, N); None: that of the order given.

    Returns:
        The best hypotheses. Not differentiable: give it detached tensors.
    """
    batch, points = problem.valid.shape
    K, keep = problem.K, sampling.keep
    best_T = torch.eye(4, dtype=K.dtype, device=K.device).repeat(batch, keep, 1, 1)
    best_quality = K.new_full((batch, keep), -1.0)
    determined = torch.zeros_like(usable)
    if batch == 0 or points < draws.shape[1]:
        return Hypotheses(best_T, best_quality, determined)
    pool = _Pool.of(problem, sampling.score_points, priority)
    # All problems take part in the first chunk, also those that are not usable: to leave them out would cost a look.
    rows: Tensor | None = None
    first = 0
    for size in _chunk_sizes(sampling.chunk, batch, len(draws), K.device):
        mine = pool if rows is None else pool.take(rows)
        samples = _solve_and_score(mine, draws[first : first + size], sampling)
        before = best_quality if rows is None else best_quality[rows]
        before_T = best_T if rows is None else best_T[rows]
        active = usable if rows is None else usable[rows]
        quality = samples.quality.masked_fill(~active.unsqueeze(1), -1.0)
        enough = None
        if sampling.confidence is not None:
            best = torch.maximum(quality.cummax(dim=1).values, before[:, :1])
            ratio = best.clamp(min=0.0).floor() / mine.scored.valid.sum(-1, keepdim=True).clamp(min=1)
            enough = _has_enough(ratio, first, sampling.confidence, draws.shape[1])
            # A sample counts if those before it were not enough.
            quality[:, 1:].masked_fill_(enough[:, :-1], -1.0)
        known = (~samples.degenerate).any(1) & active
        quality = torch.cat([before, quality], dim=1)
        # A stable sort: of equally good samples the first, on every device.
        quality, place = quality.sort(dim=1, descending=True, stable=True)
        T = torch.take_along_dim(torch.cat([before_T, samples.T], dim=1), place[:, :keep, None, None], dim=1)
        if rows is None:
            best_quality, best_T, determined = quality[:, :keep], T, known
        else:
            best_quality = best_quality.index_copy(0, rows, quality[:, :keep])
            best_T = best_T.index_copy(0, rows, T)
            determined = determined.index_copy(0, rows, determined[rows] | known)
        first += size
        if first >= len(draws):
            break
        active = active if enough is None else active & ~enough[:, -1]
        # The one look at the device's results in each chunk.
        left = active.nonzero().squeeze(-1)
        if left.numel() == 0:
            break
        rows = left if rows is None else rows[left]
    missing = best_quality < 0
    best_T = torch.where(missing[..., None, None], torch.eye(4, dtype=K.dtype, device=K.device), best_T)
    return Hypotheses(best_T, best_quality, determined)


class _Pool(NamedTuple):
    """What samples of P problems are drawn from and scored on: rays (P, N, 3) and model points (P, N, 3), indices of
    the correspondences, valid ones by priority first (P, N), how many are valid (P,), and the part that scores."""

    rays: Tensor
    points_model: Tensor
    order: Tensor
    num_valid: Tensor
    scored: PnpProblem

    @classmethod
    def of(cls, problem: PnpProblem, score_points: int | None, priority: Tensor | None) -> "_Pool":
        valid = problem.valid
        # Valid correspondences first, so that a rank among the valid ones becomes an index.
        order = torch.argsort((~valid).to(torch.uint8), dim=-1, stable=True)
        scored = _scored_points(problem, order, score_points)
        if priority is not None:
            last = priority.nan_to_num(nan=-torch.inf).masked_fill(~valid, -torch.inf)
            by_priority = last.argsort(dim=-1, descending=True, stable=True)
            # Priorities of −inf stay before what is not valid.
            missing = (~valid.gather(-1, by_priority)).to(torch.uint8)
            order = by_priority.gather(-1, missing.argsort(dim=-1, stable=True))
        rays = pixel_rays(problem.points_image, problem.K)
        return cls(rays, problem.points_model, order, valid.sum(-1), scored)

    def take(self, rows: Tensor) -> "_Pool":
        """Some of the problems."""
        rays, points_model, order, num_valid = (field[rows] for field in self[:4])
        return _Pool(rays, points_model, order, num_valid, self.scored.take(rows))


class _Samples(NamedTuple):
    """Poses (P, I, 4, 4) of samples, their qualities (P, I), −1 where not valid, and which are degenerate (P, I)."""

    T: Tensor
    quality: Tensor
    degenerate: Tensor


def _chunk_sizes(chunk: int | None, batch: int, total: int, device: torch.device) -> Iterator[int]:
    """Numbers of samples solved at once for each problem."""
    if chunk is None:
        # Few samples take as long as some more: operations cost more than numbers, up to what the cache holds.
        least, most = (2048, 4096) if device.type == "cpu" else (1 << 14, 1 << 16)
        chunk, largest = max(least // batch, 32), max(most // batch, 32)
    else:
        largest = chunk
    done = 0
    while done < total:
        size = min(chunk, total - done)
        yield size
        done += size
        chunk = min(2 * chunk, largest)


def _scored_points(problem: PnpProblem, order: Tensor, most: int | None) -> PnpProblem:
    """At most so many correspondences of each problem."""
    count, width = problem.valid.sum(-1, keepdim=True), problem.valid.shape[1]
    if most is None or most >= width:
        return problem
    place = torch.arange(most, device=order.device)
    number = count.clamp(max=most)
    # Evenly spread over the valid ones, which come in the order of the image's rows.
    rank = (place * count) // number.clamp(min=1)
    index = order.gather(1, rank.clamp(max=width - 1)).unsqueeze(-1)
    return PnpProblem(
        torch.take_along_dim(problem.points_image, index, dim=1),
        torch.take_along_dim(problem.points_model, index, dim=1),
        problem.K,
        place < number,
    )


def _solve_and_score(pool: _Pool, draws: Tensor, sampling: Sampling) -> _Samples:
    """Poses of samples and their qualities."""
    size, solve = _SOLVERS[sampling.solver]
    ranks = distinct_ranks(draws, pool.num_valid.clamp(min=size))
    index = torch.take_along_dim(pool.order, ranks.flatten(1), dim=1).unsqueeze(-1)
    solution = solve(
        torch.take_along_dim(pool.rays, index, dim=1).reshape(-1, size, 3),
        torch.take_along_dim(pool.points_model, index, dim=1).reshape(-1, size, 3),
    )
    T, valid, degenerate = (x.unflatten(0, ranks.shape[:2]) for x in solution)
    quality = score_poses(T, pool.scored, sampling.threshold)
    return _Samples(T, quality.masked_fill(~valid, -1.0), degenerate)


def _has_enough(ratio: Tensor, first: int, confidence: float, size: int) -> Tensor:
    """Whether, after each of further samples (P, I), one with inliers only has been drawn with that probability.

    Args:
        ratio: (P, I) best share of inliers so far.
        first: number of samples before these.
        confidence: the probability.
        size: correspondences of a sample.
    """
    drawn = torch.arange(first + 1, first + 1 + ratio.shape[1], device=ratio.device)
    missed = drawn * torch.log1p(-ratio.clamp(max=1.0 - 1e-6).pow(size))
    return (missed <= math.log(1.0 - confidence)) & (drawn >= _LEAST_SAMPLES)


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

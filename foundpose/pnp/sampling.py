"""Hypotheses from random minimal samples."""

import math
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.cameras import pixel_rays
from foundpose.geometry.transforms import transform_points
from foundpose.pnp.dlt import solve_dlt_minimal
from foundpose.pnp.epnp import MinimalSolution, solve_epnp_minimal
from foundpose.pnp.p3p import solve_p3p_rays
from foundpose.pnp.scoring import score_poses

# Correspondences of a sample.
_SAMPLE_SIZES = {"epnp": 4, "p3p": 4, "dlt": 6}
# A sample of inliers only may still be a poor one, through their noise: this many are drawn whatever the confidence.
_LEAST_SAMPLES = 50

SolverName = Literal["epnp", "p3p", "dlt"]


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


# Rays (S, n, 3) and model points (S, n, 3) to poses.
_SOLVERS: dict[str, Callable[[Tensor, Tensor], MinimalSolution]] = {
    "epnp": solve_epnp_minimal,
    "p3p": solve_p3p_minimal,
    "dlt": solve_dlt_minimal,
}


def sample_size(solver: str) -> int:
    """How many correspondences a minimal solver takes.

    Raises:
        ValueError: an unknown solver.
    """
    if solver not in _SOLVERS:
        raise ValueError(f"solver must be one of {sorted(_SOLVERS)}, got {solver!r}")
    return _SAMPLE_SIZES[solver]


def sample_hypotheses(
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    valid: Tensor,
    usable: Tensor,
    draws: Tensor,
    *,
    priority: Tensor | None = None,
    solver: SolverName,
    threshold: float,
    confidence: float | None,
    chunk: int | None = None,
    score_points: int | None = None,
    keep: int = 1,
) -> Hypotheses:
    """Solve and score minimal samples until each problem has had enough.

    Args:
        points_image: (B, N, 2) pixels, finite.
        points_model: (B, N, 3), finite.
        K: (B, 3, 3), invertible.
        valid: (B, N) bool.
        usable: (B,) bool, problems to look at; they have at least as many valid correspondences as a sample.
        draws: (I, n) integers in [0, 2³¹), the same for all problems; small ones stand for high priorities.
        priority: (B, N); None: that of the order given.
        solver: minimal solver.
        threshold: of an inlier, pixels.
        confidence: a problem's samples count until an all-inlier sample has been drawn with this probability (and 50
            in any case); None means that all count.
        chunk: samples solved at once; None chooses. It has no influence on the result.
        score_points: at most this many correspondences of a problem, evenly spread, score the samples; None: all.
        keep: number J of hypotheses to keep.

    Returns:
        The best hypotheses. Not differentiable: give it detached tensors.
    """
    batch, points = valid.shape
    best_T = torch.eye(4, dtype=K.dtype, device=K.device).repeat(batch, keep, 1, 1)
    best_quality = K.new_full((batch, keep), -1.0)
    determined = torch.zeros_like(usable)
    if batch == 0 or points < draws.shape[1]:
        return Hypotheses(best_T, best_quality, determined)
    # Valid correspondences first, so that a rank among the valid ones becomes an index.
    order = torch.argsort((~valid).to(torch.uint8), dim=-1, stable=True)
    spread = order
    if priority is not None:
        last = priority.nan_to_num(nan=-torch.inf).masked_fill(~valid, -torch.inf)
        by_priority = last.argsort(dim=-1, descending=True, stable=True)
        # Priorities of −inf stay before what is not valid.
        order = by_priority.gather(
            -1, (~valid.gather(-1, by_priority)).to(torch.uint8).argsort(dim=-1, stable=True)
        )
    data = _Correspondences(
        pixel_rays(points_image, K),
        points_model,
        K,
        order,
        valid.sum(-1),
        *_scored_points(points_image, points_model, valid, spread, score_points),
    )
    # All problems take part in the first chunk, also those that are not usable: to leave them out would cost a look.
    rows: Tensor | None = None
    first = 0
    for size in _chunk_sizes(chunk, batch, len(draws), points_image.device):
        mine = data if rows is None else data.take(rows)
        samples = _solve_and_score(mine, draws[first : first + size], solver, threshold)
        before = best_quality if rows is None else best_quality[rows]
        before_T = best_T if rows is None else best_T[rows]
        active = usable if rows is None else usable[rows]
        quality = samples.quality.masked_fill(~active.unsqueeze(1), -1.0)
        enough = None
        if confidence is not None:
            enough = _has_enough(before[:, :1], quality, first, mine.num_scored, confidence, draws.shape[1])
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


class _Correspondences(NamedTuple):
    """What samples of P problems are drawn from and scored on."""

    rays: Tensor
    points_model: Tensor
    K: Tensor
    order: Tensor
    num_valid: Tensor
    scored_image: Tensor
    scored_model: Tensor
    scored: Tensor
    num_scored: Tensor

    def take(self, rows: Tensor) -> "_Correspondences":
        """Some of the problems."""
        return _Correspondences(*(field[rows] for field in self))


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


def _scored_points(
    points_image: Tensor, points_model: Tensor, valid: Tensor, order: Tensor, most: int | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels (B, M, 2), points (B, M, 3) and mask (B, M) of the correspondences that score, and their number (B,)."""
    count = valid.sum(-1)
    if most is None or most >= valid.shape[1]:
        return points_image, points_model, valid, count
    place = torch.arange(most, device=valid.device)
    number = count.clamp(max=most)
    # Evenly spread over the valid ones, which come in the order of the image's rows.
    rank = (place * count.unsqueeze(1)) // number.clamp(min=1).unsqueeze(1)
    index = order.gather(1, rank.clamp(max=valid.shape[1] - 1)).unsqueeze(-1)
    return (
        torch.take_along_dim(points_image, index, dim=1),
        torch.take_along_dim(points_model, index, dim=1),
        place < number.unsqueeze(1),
        number,
    )


def _solve_and_score(data: _Correspondences, draws: Tensor, solver: SolverName, threshold: float) -> _Samples:
    """Poses of samples and their qualities."""
    size = draws.shape[1]
    ranks = distinct_ranks(draws, data.num_valid.clamp(min=size))
    index = torch.take_along_dim(data.order, ranks.flatten(1), dim=1).unsqueeze(-1)
    solution = _SOLVERS[solver](
        torch.take_along_dim(data.rays, index, dim=1).reshape(-1, size, 3),
        torch.take_along_dim(data.points_model, index, dim=1).reshape(-1, size, 3),
    )
    samples = ranks.shape[:2]
    T = solution.T_camera_from_model.unflatten(0, samples)
    quality = score_poses(T, data.scored_image, data.scored_model, data.K, data.scored, threshold)
    return _Samples(
        T,
        quality.masked_fill(~solution.valid.unflatten(0, samples), -1.0),
        solution.degenerate.unflatten(0, samples),
    )


def _has_enough(
    before: Tensor, quality: Tensor, first: int, num_scored: Tensor, confidence: float, size: int
) -> Tensor:
    """Whether, after each of further samples (P, I), one with inliers only has been drawn with that probability.

    Args:
        before: (P, 1) best quality before these samples.
        quality: (P, I).
        first: number of samples before these.
        num_scored: (P,) number of correspondences that the qualities count.
        confidence: the probability.
        size: correspondences of a sample.
    """
    best = torch.maximum(quality.cummax(dim=1).values, before)
    ratio = best.clamp(min=0.0).floor() / num_scored.clamp(min=1).unsqueeze(1)
    drawn = torch.arange(first + 1, first + 1 + quality.shape[1], device=quality.device)
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

"""k-means clustering in blocks of matrix products.

Lloyd's iterations with three changes that reach a lower inertia in a fraction of the time:

- centroids step beyond the mean of their points (over-relaxation). For a factor ω in (0, 2) the cost of a fixed
  assignment still falls, by 1 − (1 − ω)² of what the mean would gain, and far fewer iterations are needed;
- centroids that nobody would miss (their points are nearly as close to the next centroid) are moved into
  clusters that gain most from a split, which leads out of the local minimum of the initialisation;
- where there are many centroids, most iterations compare a point with those around it only; every seventh, and the
  last, with all. They end only where a search of all gains no more than one nearby.

For 2048 clusters of 100,000 points (mixtures, and smooth codes, of 128 channels; one core): without the first it
takes 2 to 23 % longer for an inertia up to 0.7 % higher, without the second the inertia is 1 to 10 % higher, without
the third it takes 1.3 to 2.3 times as long.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.clustering.assignment import cluster_means, find_nearest
from foundpose.clustering.neighbourhoods import Neighbourhoods

OnIteration = Callable[[int, float], None]

_RELAXATION = 1.8
# All centroids are searched at least this often, where neighbourhoods are searched otherwise.
_ALL_EVERY = 7
_ROWS_PER_BLOCK = 8192
# The initial centroids are drawn in this many batches, from this many points per cluster.
_INITIAL_BATCHES = 16
_SAMPLES_PER_CLUSTER = 16
# Centroids are moved in iterations 1, 3, 5, ... (from 0) until fewer than 1 % of them move.
_FIRST_MOVE = 1
_MOVE_EVERY = 2
_FEW_MOVES = 0.01


class KMeansResult(NamedTuple):
    """Clusters of N points.

    Attributes:
        centroids: (k, d).
        assignment: (N,) nearest centroid of each point, int64; every centroid has at least one point.
        inertia: () sum of squared distances to the centroids, float64 (float32 on devices without it).
        num_iterations: iterations made.
    """

    centroids: Tensor
    assignment: Tensor
    inertia: Tensor
    num_iterations: int


def draw_initial(points: Tensor, num_clusters: int, generator: torch.Generator) -> Tensor:
    """Draw (k, d) of the points, in batches, with probability proportional to the squared distance to earlier ones.

    This is k-means++ with batches in place of single draws, on a sample of the points. The random numbers are
    made on the CPU, so that they are the same for every device.

    Source: Bahmani et al., "Scalable k-means++", VLDB 2012.
    """
    chosen = torch.randperm(len(points), generator=generator)[: _SAMPLES_PER_CLUSTER * num_clusters]
    sample = points[chosen.to(points.device)]
    batch = -(-num_clusters // _INITIAL_BATCHES)
    drawn = [sample[:batch]]
    _, cost, _ = find_nearest(sample, drawn[0])
    while (missing := num_clusters - sum(part.shape[0] for part in drawn)) > 0:
        # The smallest of exponential variates divided by weights: draws without replacement.
        uniform = torch.rand(sample.shape[0], generator=generator, dtype=torch.float64).clamp(min=1e-300)
        key = uniform.log().neg().to(cost) / cost
        new = sample[key.topk(min(batch, missing), largest=False).indices]
        cost = torch.minimum(cost, find_nearest(sample, new)[1])
        drawn.append(new)
    return torch.cat(drawn)


def split_gains(points: Tensor, assignment: Tensor, centroids: Tensor) -> tuple[Tensor, Tensor]:
    """What the cost falls by when a cluster is split in two, and the halves.

    The split is by a plane through the centroid, across the line between the means of a first, random split.

    Args:
        points: (N, d).
        assignment: (N,) in [0, k).
        centroids: (k, d) means of the clusters.

    Returns:
        Gains (k,), and the means of the halves (k, 2, d).
    """
    k = centroids.shape[0]
    # Start from the direction of one member of the cluster (of any point, for an empty cluster).
    ordered, order = assignment.sort(stable=True)
    first = torch.searchsorted(ordered, torch.arange(k, device=points.device)).clamp(max=points.shape[0] - 1)
    direction = points[order[first]] - centroids
    for _ in range(2):
        offset = (centroids * direction).sum(dim=1)
        blocks = zip(points.split(_ROWS_PER_BLOCK), assignment.split(_ROWS_PER_BLOCK), strict=True)
        side = torch.cat([(x * direction[a]).sum(dim=1) > offset[a] for x, a in blocks])
        halves, sizes = cluster_means(points, 2 * assignment + side, centroids.repeat_interleave(2, dim=0))
        halves = halves.unflatten(0, (k, 2))
        direction = halves[:, 1] - halves[:, 0]
    gains = ((halves - centroids.unsqueeze(1)).square().sum(dim=2) * sizes.unflatten(0, (k, 2))).sum(dim=1)
    return gains, halves


def relocate(
    points: Tensor, assignment: Tensor, cost: Tensor, second_cost: Tensor, centroids: Tensor
) -> tuple[Tensor, Tensor]:
    """Move the most dispensable centroids into the clusters that gain most from a split.

    Removing a centroid costs at most what its points lose by going to their second nearest centroid; a move is
    made where a split gains more. Empty clusters cost nothing to move; of the others at most a tenth moves, so
    that a removed centroid's points find their second choice still there.

    Args:
        points: (N, d).
        assignment: (N,) nearest centroids.
        cost: (N,) squared distances to them.
        second_cost: (N,) squared distances to the second nearest centroids.
        centroids: (k, d) means of the clusters.

    Returns:
        New centroids (k, d) and the number of moves ().
    """
    k = centroids.shape[0]
    loss = cluster_means((second_cost - cost).unsqueeze(1), assignment, centroids.new_zeros(k, 1))
    loss_of_removal = loss[0].squeeze(1) * loss[1]
    gains, halves = split_gains(points, assignment, centroids)
    half = k // 2
    removed = loss_of_removal.sort(stable=True).indices[:half]
    few = torch.arange(half, device=points.device) < max(1, k // 10)
    candidate = few | (loss[1][removed] == 0)
    # A centroid that may go cannot take in another.
    open_gains = gains.index_put((removed,), torch.where(candidate, -1.0, gains[removed]))
    split = open_gains.sort(descending=True, stable=True).indices[:half]
    move = candidate & (gains[split] > loss_of_removal[removed])
    moved = centroids.clone()
    moved[removed] = torch.where(move.unsqueeze(1), halves[split, 0], centroids[removed])
    moved[split] = torch.where(move.unsqueeze(1), halves[split, 1], centroids[split])
    return moved, move.sum()


def fill_empty_clusters(
    points: Tensor, assignment: Tensor, centroids: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Put empty clusters' centroids on the costliest points, and compute exact costs.

    Args:
        points: (N, d).
        assignment: (N,) nearest centroids.
        centroids: (k, d).

    Returns:
        Centroids (k, d), assignment (N,) without empty clusters, costs (N,).

    Raises:
        ValueError: If there are fewer distinct points than clusters.
    """
    k = centroids.shape[0]
    blocks = zip(points.split(_ROWS_PER_BLOCK), assignment.split(_ROWS_PER_BLOCK), strict=True)
    cost = torch.cat([(x - centroids[a]).square().sum(dim=1) for x, a in blocks])
    sizes = torch.zeros(k, dtype=torch.int64, device=points.device).scatter_add_(
        0, assignment, torch.ones_like(assignment)
    )
    while bool((sizes == 0).any()):
        empty = (sizes == 0).to(torch.int64).argmax()
        # A point that is alone has nothing to give. One that coincides with its centroid has no need.
        seed = cost.where(sizes[assignment] > 1, cost.new_zeros(())).argmax()
        if not bool(cost[seed] > 0):
            raise ValueError(
                f"cannot make {k} clusters of points of which only {int((sizes > 0).sum())} differ"
            )
        # A point on a centroid has cost 0 and never leaves it again, so this ends.
        distance = torch.cat([(x - points[seed]).square().sum(dim=1) for x in points.split(_ROWS_PER_BLOCK)])
        nearer = distance < cost
        centroids = centroids.index_copy(0, empty[None], points[seed][None])
        assignment, cost = torch.where(nearer, empty, assignment), torch.where(nearer, distance, cost)
        sizes = torch.zeros_like(sizes).scatter_add_(0, assignment, torch.ones_like(assignment))
    return centroids, assignment, cost


def kmeans(
    points: Tensor,
    num_clusters: int,
    num_iterations: int = 25,
    seed: int = 0,
    tolerance: float = 1e-3,
    progress: OnIteration | None = None,
) -> KMeansResult:
    """Cluster points.

    The initial centroids are drawn with the seed from random numbers that do not depend on the device.
    Iterations end early when the inertia falls by less than ``tolerance`` of itself.

    Args:
        points: (N, d) floating point.
        num_clusters: number k of clusters.
        num_iterations: upper bound, at least 1.
        seed: of the initial centroids.
        tolerance: relative fall of the inertia per iteration at which to stop; 0 uses all iterations.
        progress: called after each iteration with its number (from 1) and the inertia before it.

    Returns:
        Centroids, assignment, inertia.

    Raises:
        ValueError: If shapes or settings are wrong, points are not finite, or there are fewer (distinct) points
            than clusters.

    Not differentiable: points are detached.
    """
    _check_arguments(points, num_clusters, num_iterations)
    points = points.detach()
    # Centred, products lose less to rounding.
    centre = points.mean(dim=0)
    if not bool(torch.isfinite(centre).all()):
        raise ValueError("points have NaN or infinite entries: check the descriptors")
    points = points - centre
    generator = torch.Generator().manual_seed(seed)
    initial = draw_initial(points, num_clusters, generator)
    centroids, made = _iterate(points, initial, num_iterations, tolerance, progress)
    assignment, _, _ = find_nearest(points, centroids)
    centroids, assignment, cost = fill_empty_clusters(points, assignment, centroids)
    return KMeansResult(centroids + centre, assignment, cost.sum(dtype=_sum_dtype(cost)), made)


def _iterate(
    points: Tensor, centroids: Tensor, num_iterations: int, tolerance: float, progress: OnIteration | None
) -> tuple[Tensor, int]:
    """Centroids after at most ``num_iterations`` and the number of iterations made."""
    near: Neighbourhoods | None = None
    next_search_of_all = 0
    next_move = _FIRST_MOVE
    previous: float | None = None
    for iteration in range(num_iterations):
        final = iteration == num_iterations - 1
        moving = iteration == next_move and not final
        if final or iteration >= next_search_of_all:
            near = None  # makes room: it has a copy of all points
        searched = points if near is None else near.points
        index, cost, second_cost = (
            find_nearest(points, centroids, moving) if near is None else near.find_nearest(centroids, moving)
        )
        inertia = float(cost.sum(dtype=_sum_dtype(cost)))
        if progress is not None:
            progress(iteration + 1, inertia)
        means, _ = cluster_means(searched, index, centroids)
        slow = previous is not None and previous - inertia <= tolerance * previous and iteration > next_move
        if final or (near is None and slow):
            return means, iteration + 1
        if moving and second_cost is not None:
            centroids, moves = relocate(searched, index, cost, second_cost, means)
            if int(moves) > _FEW_MOVES * centroids.shape[0]:
                next_move = iteration + _MOVE_EVERY
            previous = None
            continue
        centroids = means if iteration == 0 else torch.lerp(centroids, means, _RELAXATION)
        previous = inertia
        if near is None and Neighbourhoods.worthwhile(len(means)):
            near = Neighbourhoods.around(points, index, means)
            next_search_of_all = iteration + _ALL_EVERY
            # The next search finds the inertia a trace too high, which must not look like the end.
            previous = None
        elif slow:
            next_search_of_all = iteration + 1
    raise AssertionError("the final iteration returns")


def _sum_dtype(cost: Tensor) -> torch.dtype:
    return torch.float32 if cost.device.type == "mps" else torch.float64


def _check_arguments(points: Tensor, num_clusters: int, num_iterations: int) -> None:
    if points.ndim != 2 or not points.is_floating_point():
        raise ValueError(
            f"points must be floating point of shape (N, d), got {tuple(points.shape)} {points.dtype}"
        )
    if num_clusters < 1 or num_iterations < 1:
        raise ValueError(
            f"num_clusters and num_iterations must be at least 1, got {num_clusters} and {num_iterations}"
        )
    if points.shape[0] < num_clusters:
        raise ValueError(f"cannot make {num_clusters} clusters of {points.shape[0]} points")

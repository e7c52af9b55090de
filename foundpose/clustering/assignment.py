"""Assignment of points to centroids and means of clusters, in blocks of matrix products."""

import torch
import torch.nn.functional as F
from torch import Tensor

# Scores of a block of points against all centroids; on a CPU they stay in the cache.
_CPU_SCORES_PER_BLOCK = 1 << 21
_GPU_SCORES_PER_BLOCK = 1 << 26
# The search for the smallest of k scores first takes minima of groups, which is vectorised, unlike argmin.
_GROUP = 64


def find_nearest(
    points: Tensor, centroids: Tensor, with_second: bool = False
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Nearest centroid of each point; the memory is that of one block of scores.

    Args:
        points: (N, d), floating point.
        centroids: (k, d).
        with_second: whether to tell the distance to the second nearest centroid, too.

    Returns:
        Index (N,), squared distance (N,) and squared distance to the second nearest (N,) or None (inf if k = 1).
        Of equally near centroids the first.
    """
    k = centroids.shape[0]
    norms = centroids.square().sum(dim=1)
    padding = -k % _GROUP
    norms = F.pad(norms, (0, padding), value=torch.inf)
    transposed = F.pad(centroids, (0, 0, 0, padding)).T
    groups = (k + padding) // _GROUP
    budget = _CPU_SCORES_PER_BLOCK if points.device.type == "cpu" else _GPU_SCORES_PER_BLOCK
    rows = max(1, budget // (groups * _GROUP))
    # Written in place: small results kept from each block would fragment the heap between the large ones.
    index = points.new_empty(len(points), dtype=torch.int64)
    cost = points.new_empty(len(points))
    second_cost = torch.empty_like(cost) if with_second else None
    for start in range(0, points.shape[0], rows):
        block = slice(start, start + rows)
        x = points[block]
        # |x|² is the same for all centroids and is added at the end.
        scores = torch.sub(norms, x @ transposed, alpha=2.0)
        grouped = scores.unflatten(1, (groups, _GROUP))
        group = grouped.amin(dim=2).argmin(dim=1)
        nearest = grouped.gather(1, group[:, None, None].expand(-1, 1, _GROUP)).squeeze(1).min(dim=1)
        squared_norms = torch.linalg.vector_norm(x, dim=1).square()
        cost[block] = nearest.values.add_(squared_norms).clamp_(min=0)
        index[block] = group * _GROUP + nearest.indices
        if second_cost is not None:
            second = scores.scatter_(1, index[block, None], torch.inf).amin(dim=1)
            second_cost[block] = second.add_(squared_norms).clamp_(min=0)
    return index, cost, second_cost


def cluster_means(points: Tensor, assignment: Tensor, centroids: Tensor) -> tuple[Tensor, Tensor]:
    """Means of the clusters and their sizes; an empty cluster keeps its centroid.

    Sums run over the points of one cluster in order, so the result is deterministic on every device.

    Args:
        points: (N, d).
        assignment: (N,) in [0, k).
        centroids: (k, d).

    Returns:
        Means (k, d) and sizes (k,).
    """
    k = centroids.shape[0]
    ordered, order = assignment.sort(stable=True)
    bounds = torch.searchsorted(ordered, torch.arange(k + 1, device=points.device))
    sizes = bounds.diff()
    sums = F.embedding_bag(order, points, bounds[:-1], mode="sum")
    return torch.where(sizes.unsqueeze(1) > 0, sums / sizes.clamp(min=1).unsqueeze(1), centroids), sizes

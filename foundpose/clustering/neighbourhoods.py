"""Nearest centroids among those nearby: an assignment at a fraction of the cost of looking at all centroids."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from foundpose.clustering.assignment import cluster_means, find_nearest

# Centroids that a point is compared with, and how many of them are the heart of its neighbourhood.
_CANDIDATES = 256
_HEART = 32
_ITERATIONS = 5


class Neighbourhoods(NamedTuple):
    """Points in groups that lie close together, each with a few hundred centroids around it.

    A point's nearest centroid of now is, in all but rare cases, one of those that were near the nearest one of some
    iterations ago. So a search among these is as good as one among all while centroids move little, and costs a
    matrix product of 256 columns per point.

    Attributes:
        points: (N, d), those of a group one after another.
        bounds: group g has the points ``bounds[g]`` to ``bounds[g + 1]``.
        anchors: (k, d) the centroids when the groups were made.
        groups: (k,) the group of each of them.
    """

    points: Tensor
    bounds: list[int]
    anchors: Tensor
    groups: Tensor

    @staticmethod
    def worthwhile(num_centroids: int) -> bool:
        """Whether there are enough centroids to leave most of them out."""
        return num_centroids >= 4 * _CANDIDATES

    @classmethod
    def around(cls, points: Tensor, assignment: Tensor, centroids: Tensor) -> Self:
        """Group points by the centroids that they are assigned to.

        Args:
            points: (N, d).
            assignment: (N,) nearest centroids.
            centroids: (k, d), k a few times the number of centroids in a neighbourhood.
        """
        groups = _group(centroids)
        of_points, order = groups[assignment].sort(stable=True)
        numbers = torch.arange(int(groups.max()) + 2, device=points.device)
        bounds = torch.searchsorted(of_points, numbers).tolist()
        return cls(points[order], bounds, centroids, groups)

    def find_nearest(
        self, centroids: Tensor, with_second: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Nearest centroid of each point among those of its neighbourhood.

        Args:
            centroids: (k, d) of now.
            with_second: whether to tell the distance to the second nearest, too.

        Returns:
            As :func:`foundpose.clustering.assignment.find_nearest`, for the points in this order.
        """
        index = self.points.new_empty(len(self.points), dtype=torch.int64)
        cost = self.points.new_empty(len(self.points))
        second_cost = torch.empty_like(cost) if with_second else None
        for group, candidates in enumerate(self._candidates(centroids)):
            members = slice(self.bounds[group], self.bounds[group + 1])
            found = find_nearest(self.points[members], centroids[candidates], with_second)
            index[members], cost[members] = candidates[found[0]], found[1]
            if second_cost is not None and found[2] is not None:
                second_cost[members] = found[2]
        return index, cost, second_cost

    def _candidates(self, centroids: Tensor) -> Tensor:
        """(G, 256) the centroids nearest to any of a group's anchors, ascending."""
        distance = torch.cdist(self.anchors, centroids)
        to_group = distance.new_full((len(self.bounds) - 1, len(centroids)), torch.inf)
        to_group.scatter_reduce_(0, self.groups[:, None].expand_as(distance), distance, "amin")
        return to_group.topk(_CANDIDATES, dim=1, largest=False).indices.sort(dim=1).values


def _group(centroids: Tensor) -> Tensor:
    """(k,) groups of about 32 centroids that lie close together."""
    hearts = centroids[::_HEART]
    for _ in range(_ITERATIONS):
        hearts, _ = cluster_means(centroids, find_nearest(centroids, hearts)[0], hearts)
    return find_nearest(centroids, hearts)[0]

"""A tree of regions: neighbouring cells of a feature map, merged by Ward's criterion."""

from typing import NamedTuple

import torch
from torch import Tensor


class RegionTree(NamedTuple):
    """Regions of N feature maps (h, w), nested: a cell is a region, and so is the union of two that were merged.

    The first N · h · w nodes are the cells, map by map and row by row; a parent comes after its children.

    Attributes:
        parent: (M,) the region that a region was merged into; its own number where there is none.
        size: (M,) number of cells.
        image: (M,) the map that a region belongs to.
    """

    parent: Tensor
    size: Tensor
    image: Tensor


def region_tree(features: Tensor) -> RegionTree:
    """Merge neighbouring cells of feature maps until each map is one region.

    In each round, all pairs of neighbouring regions merge that are nearest to each other: the pairs whose union adds
    least to the sum of squared distances from the regions' means (Ward). Without the restriction to neighbours this
    gives the same tree as merging one pair at a time; with it, nearly. The maps share the rounds.

    Args:
        features: (N, C, h, w).

    Not differentiable (a choice).
    """
    count, channels, height, width = features.shape
    cells = count * height * width
    device = features.device
    total = features.detach().permute(0, 2, 3, 1).reshape(cells, channels)
    size = torch.ones(cells, device=device, dtype=total.dtype)
    node = torch.arange(cells, device=device)  # of each active region
    image = node // max(height * width, 1)
    parents, sizes, images = [node.clone()], [size], [image]
    edges = _grid_edges(count, height, width, device)
    made = cells
    while len(edges):
        first, second = edges.unbind(1)
        mean = total / size[:, None]
        cost = (mean[first] - mean[second]).square().sum(1) * (
            size[first] * size[second] / (size[first] + size[second])
        )
        chosen = _mutually_nearest(edges, cost, len(size))
        first, second = edges[chosen].unbind(1)
        new = made + torch.arange(len(first), device=device)
        made += len(first)
        for side in (first, second):
            _set(parents, node[side], new)
        # The second region of a pair moves into the first; places of regions that are gone close up.
        total = total.index_add(0, first, total[second])
        size = size.index_add(0, first, size[second])
        node = node.index_copy(0, first, new)
        parents.append(new.clone())
        sizes.append(size[first])
        images.append(image[first])
        target = torch.arange(len(size), device=device).index_copy(0, second, first)
        left = torch.ones(len(size), dtype=torch.bool, device=device).index_fill(0, second, False)
        place = left.cumsum(0) - 1
        total, size, node, image = total[left], size[left], node[left], image[left]
        edges = place[target[edges]].sort(dim=1).values
        edges = edges[edges[:, 0] != edges[:, 1]].unique(dim=0)
    return RegionTree(torch.cat(parents), torch.cat(sizes).long(), torch.cat(images))


def _set(parents: list[Tensor], nodes: Tensor, values: Tensor) -> None:
    """Set the parents of nodes, which lie in the tensors of several rounds."""
    start = 0
    for part in parents:
        inside = (nodes >= start) & (nodes < start + len(part))
        part[nodes[inside] - start] = values[inside]
        start += len(part)


def _grid_edges(count: int, height: int, width: int, device: torch.device) -> Tensor:
    """Pairs (E, 2) of cells that share a side."""
    cell = torch.arange(count * height * width, device=device).reshape(count, height, width)
    across = torch.stack([cell[:, :, :-1].flatten(), cell[:, :, 1:].flatten()], dim=1)
    down = torch.stack([cell[:, :-1].flatten(), cell[:, 1:].flatten()], dim=1)
    return torch.cat([across, down])


def _mutually_nearest(edges: Tensor, cost: Tensor, regions: int) -> Tensor:
    """Which edges (E,) join two regions that are each other's nearest; of equal ones the first counts as nearest."""
    rank = torch.empty_like(cost, dtype=torch.long)
    rank[cost.argsort(stable=True)] = torch.arange(len(cost), device=cost.device)
    best = torch.full((regions,), len(cost), dtype=torch.long, device=cost.device)
    best = best.scatter_reduce(0, edges.flatten(), rank[:, None].expand(-1, 2).flatten(), "amin")
    return (best[edges] == rank[:, None]).all(dim=1)

import numpy as np
import torch
from sklearn.cluster import AgglomerativeClustering, ward_tree
from sklearn.feature_extraction.image import grid_to_graph
from torch import Tensor

from foundpose.detection import RegionTree, region_tree


def members(tree: RegionTree, cells: int) -> set[frozenset[int]]:
    """All regions as sets of cells."""
    inside: list[set[int]] = [{i} if i < cells else set() for i in range(len(tree.parent))]
    for node, parent in enumerate(tree.parent.tolist()):
        if parent != node:
            inside[parent] |= inside[node]
    return {frozenset(region) for region in inside}


def grid_graph(height: int, width: int) -> np.ndarray:
    return grid_to_graph(height, width)


def spread(features: Tensor, labels: np.ndarray) -> float:
    """Sum of squared distances from the regions' means."""
    x = features.flatten(1).T.numpy()
    return sum(((x[labels == k] - x[labels == k].mean(0)) ** 2).sum() for k in np.unique(labels))


def cut(tree: RegionTree, cells: int, count: int) -> np.ndarray:
    """Labels of the cells when the last ``count - 1`` merges are undone."""
    nodes = len(tree.parent)
    root = np.arange(nodes)
    for node in range(nodes - 1, -1, -1):
        parent = int(tree.parent[node])
        root[node] = node if parent == node or parent >= nodes - (count - 1) else root[parent]
    return root[:cells]


def test_merges_as_ward_does_with_the_same_neighbours() -> None:
    """With the restriction to neighbours the order of merges can matter, but seldom does."""
    shares = []
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        height, width = torch.randint(2, 8, (2,), generator=generator).tolist()
        features = torch.randn(3, height, width, generator=generator).double()
        tree = region_tree(features[None])
        cells = height * width
        assert len(tree.parent) == 2 * cells - 1
        children, *_ = ward_tree(features.flatten(1).T.numpy(), connectivity=grid_graph(height, width))
        theirs = [{i} for i in range(cells)]
        for a, b in children:
            theirs.append(theirs[a] | theirs[b])
        shares.append(len(members(tree, cells) & set(map(frozenset, theirs))) / (2 * cells - 1))
    assert np.mean(shares) > 0.9


def test_regions_of_one_value_are_found() -> None:
    labels = torch.zeros(12, 15, dtype=torch.long)
    labels[2:6, 3:9] = 1
    labels[7:11, 8:14] = 2
    values = torch.tensor([[0.0, 0.0], [5.0, 1.0], [-2.0, 6.0]])
    noise = 0.1 * torch.randn(2, 12, 15, generator=torch.Generator().manual_seed(0))
    tree = region_tree((values[labels].permute(2, 0, 1) + noise)[None])
    found = members(tree, 180)
    for label in (0, 1, 2):
        assert frozenset((labels.flatten() == label).nonzero().flatten().tolist()) in found


def test_sizes_and_images() -> None:
    features = torch.randn(3, 4, 6, 5, generator=torch.Generator().manual_seed(1))
    tree = region_tree(features)
    children = torch.zeros(len(tree.parent), dtype=torch.long)
    moved = tree.parent != torch.arange(len(tree.parent))
    children.index_add_(0, tree.parent[moved], tree.size[moved])
    inner = torch.arange(len(tree.parent)) >= 3 * 30
    assert torch.equal(children[inner], tree.size[inner])
    assert torch.equal(tree.image[tree.parent], tree.image)
    assert (tree.parent[moved] > torch.arange(len(tree.parent))[moved]).all()
    assert tree.size[~moved].tolist() == [30, 30, 30]


def test_a_map_alone_as_among_others() -> None:
    features = torch.randn(3, 4, 6, 5, generator=torch.Generator().manual_seed(2))
    together = region_tree(features)
    for n in range(3):
        alone = members(region_tree(features[n : n + 1]), 30)
        cells = [frozenset(c - 30 * n for c in region) for region in members(together, 90)]
        mine = {region for region in cells if region and min(region) >= 0 and max(region) < 30}
        assert mine == alone


def test_equal_cells_merge_to_one_region() -> None:
    tree = region_tree(torch.zeros(1, 2, 5, 5))
    assert int(tree.size.max()) == 25


def test_spread_is_that_of_greedy_ward() -> None:
    features = torch.randn(4, 16, 16, generator=torch.Generator().manual_seed(3)).double()
    features = torch.nn.functional.avg_pool2d(features[None], 3, 1, 1)[0]
    theirs = AgglomerativeClustering(n_clusters=12, connectivity=grid_graph(16, 16)).fit(
        features.flatten(1).T.numpy()
    )
    ours = spread(features, cut(region_tree(features[None]), 256, 12))
    assert ours < 1.1 * spread(features, theirs.labels_)

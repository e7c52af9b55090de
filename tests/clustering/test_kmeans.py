import importlib
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import KMeans
from torch import Tensor

import foundpose.clustering.assignment as assignment_module
from foundpose.clustering.assignment import cluster_means, find_nearest
from foundpose.clustering.kmeans import (
    draw_initial,
    fill_empty_clusters,
    kmeans,
    relocate,
    split_gains,
)
from foundpose.clustering.neighbourhoods import Neighbourhoods
from foundpose.retrieval.words import VisualWords

# The package exports a function of the module's name.
kmeans_module = importlib.import_module("foundpose.clustering.kmeans")


def mixture(count: int, channels: int, modes: int, spread: float, seed: int = 0) -> Tensor:
    """Overlapping anisotropic clusters of unequal sizes, variances ∝ 1 / i as after a PCA."""
    g = torch.Generator().manual_seed(seed)
    scale = torch.arange(1, channels + 1).float().rsqrt()
    centres = torch.randn(modes, channels, generator=g) * scale
    mode = torch.multinomial(torch.rand(modes, generator=g) ** 3, count, replacement=True, generator=g)
    width = 0.2 + spread * torch.rand(modes, 1, generator=g)
    return centres[mode] + torch.randn(count, channels, generator=g) * scale * width[mode]


def exact_costs(points: Tensor, centroids: Tensor) -> Tensor:
    return torch.cdist(
        points.double(), centroids.double(), compute_mode="donot_use_mm_for_euclid_dist"
    ).square()


@pytest.mark.parametrize(("spread", "num_iterations"), [(0.3, 25), (0.6, 10), (1.0, 25)])
def test_inertia_is_not_above_sklearns(spread: float, num_iterations: int) -> None:
    x = mixture(10_000, 64, 200, spread)
    ours = kmeans(x, 128, num_iterations=num_iterations)
    reference = KMeans(128, n_init=1, max_iter=num_iterations, tol=0, random_state=0).fit(x.numpy())
    assert ours.inertia.item() <= 1.002 * reference.inertia_


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_result_is_consistent(dtype: torch.dtype) -> None:
    x = mixture(3000, 16, 60, 0.5).to(dtype) + 30.0
    result = kmeans(x, 100)
    assert result.centroids.shape == (100, 16)
    assert result.centroids.dtype == dtype
    costs = exact_costs(x, result.centroids)
    own = costs.gather(1, result.assignment[:, None])[:, 0]
    torch.testing.assert_close(own, costs.amin(1), atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(result.inertia, own.sum(), rtol=1e-4, atol=0)
    assert (result.assignment.bincount(minlength=100) > 0).all()
    # Close to a fixed point of Lloyd's algorithm: replacing centroids by means gains next to nothing.
    means, _ = cluster_means(x, result.assignment, result.centroids)
    assert exact_costs(x, means).amin(1).sum() >= 0.995 * result.inertia


def test_deterministic_and_seeded() -> None:
    x = mixture(4000, 16, 60, 0.5)
    first, again, other = kmeans(x, 64, seed=3), kmeans(x, 64, seed=3), kmeans(x, 64, seed=4)
    assert torch.equal(first.centroids, again.centroids)
    assert not torch.equal(first.centroids, other.centroids)
    state = torch.random.get_rng_state()
    kmeans(x, 64)
    assert torch.equal(state, torch.random.get_rng_state())


def test_recovers_separated_clusters() -> None:
    g = torch.Generator().manual_seed(0)
    centres = torch.randn(40, 8, generator=g) * 100
    label = torch.arange(4000) % 40
    result = kmeans(centres[label] + torch.randn(4000, 8, generator=g), 40)
    nearest = torch.cdist(centres, result.centroids).min(1)
    assert nearest.values.max() < 1.0
    assert torch.equal(nearest.indices[label], result.assignment)


def test_find_nearest_equals_brute_force(monkeypatch: pytest.MonkeyPatch) -> None:
    x, c = mixture(500, 10, 20, 1.0).double(), mixture(130, 10, 20, 1.0, seed=1).double()
    expected = exact_costs(x, c).topk(2, dim=1, largest=False)
    for budget in (1 << 21, 192 * 7):
        monkeypatch.setattr(assignment_module, "_CPU_SCORES_PER_BLOCK", budget)
        index, cost, second = find_nearest(x, c, with_second=True)
        assert torch.equal(index, expected.indices[:, 0])
        torch.testing.assert_close(cost, expected.values[:, 0])
        torch.testing.assert_close(second, expected.values[:, 1])


def coordinate_codes(count: int, channels: int, seed: int = 0) -> Tensor:
    """Descriptors that vary smoothly over a surface: lengths of 40 beside clusters of a few units."""
    g = torch.Generator().manual_seed(seed)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    directions = torch.nn.functional.normalize(torch.randn(3, channels, generator=g), dim=0)
    phases = 6.3 * torch.rand(channels, generator=g)
    return 40.0 * (2.0 / channels) ** 0.5 * torch.cos(2.0 * points @ directions + phases)


def test_clusters_that_are_small_beside_the_descriptors() -> None:
    x = coordinate_codes(10_000, 64)
    reference = KMeans(128, n_init=1, max_iter=25, tol=0, random_state=0).fit(x.numpy())
    assert reference.inertia_ / len(x) < 0.02 * 40**2
    assert kmeans(x, 128).inertia.item() <= 1.002 * reference.inertia_


@pytest.mark.parametrize("kind", ["mixture", "codes"])
def test_searching_neighbourhoods_does_not_change_the_outcome(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = mixture(30_000, 32, 1500, 0.6) if kind == "mixture" else coordinate_codes(30_000, 32)
    searched = []
    find = kmeans_module.find_nearest

    def counted(points: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor | None]:
        searched.append(len(points))
        return find(points, *arguments)

    monkeypatch.setattr(kmeans_module, "find_nearest", counted)
    near = kmeans(x, 1024)
    of_all = searched.count(len(x))
    assert of_all < 0.5 * near.num_iterations
    monkeypatch.setattr(kmeans_module.Neighbourhoods, "worthwhile", lambda k: False)
    everywhere = kmeans(x, 1024, num_iterations=near.num_iterations)
    assert searched.count(len(x)) - of_all >= everywhere.num_iterations
    # Other steps lead to another local minimum; those of other seeds lie as far apart.
    assert near.inertia <= 1.005 * everywhere.inertia


def test_neighbourhoods_hold_all_points_and_search_what_is_near() -> None:
    x, centroids = mixture(4000, 8, 500, 0.6).double(), mixture(1030, 8, 500, 0.6, seed=1).double()
    assignment, _, _ = find_nearest(x, centroids)
    near = Neighbourhoods.around(x, assignment, centroids)
    assert torch.equal(near.points.sort(dim=0).values, x.sort(dim=0).values)
    assert near.bounds[0] == 0
    assert near.bounds[-1] == len(x)
    sizes = near.groups.bincount()
    assert 16 < sizes.double().mean() < 64
    moved = centroids + 0.01 * torch.randn(
        centroids.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    index, cost, second = near.find_nearest(moved, with_second=True)
    expected = exact_costs(near.points, moved).topk(2, dim=1, largest=False)
    right = index == expected.indices[:, 0]
    assert right.double().mean() > 0.99
    torch.testing.assert_close(cost[right], expected.values[right, 0])
    assert (second >= cost).all()
    assert torch.isclose(second, expected.values[:, 1]).double().mean() > 0.9
    assert (cost / expected.values[:, 0]).mean() < 1.001
    torch.testing.assert_close(cost, (near.points - moved[index]).square().sum(1))


def test_cluster_means_equal_numpy_and_keep_empty() -> None:
    x = mixture(200, 5, 10, 0.5).double()
    assignment = torch.randint(0, 9, (200,), generator=torch.Generator().manual_seed(0))
    old = torch.full((10, 5), 7.0, dtype=torch.float64)
    means, sizes = cluster_means(x, assignment, old)
    for j in range(9):
        np.testing.assert_allclose(means[j], x[assignment == j].numpy().mean(0))
    assert torch.equal(sizes, assignment.bincount(minlength=10))
    assert torch.equal(means[9], old[9])


def test_split_gain_is_what_the_split_saves() -> None:
    x = mixture(2000, 6, 30, 0.5).double()
    assignment = kmeans(x, 12).assignment
    centroids, _ = cluster_means(x, assignment, torch.zeros(12, 6).double())
    gains, halves = split_gains(x, assignment, centroids)
    for j in range(12):
        members = x[assignment == j]
        before = (members - centroids[j]).square().sum()
        after = exact_costs(members, halves[j]).amin(1).sum()
        assert gains[j] > 0
        # The nearer half is at least as good as the half that the plane gives.
        assert after <= before - gains[j] + 1e-9


def test_relocation_lowers_the_cost() -> None:
    # Two centroids share one cluster, two clusters share one centroid.
    g = torch.Generator().manual_seed(0)
    centres = torch.tensor([[0.0, 0.0], [50.0, 0.0], [60.0, 0.0], [0.0, 90.0]])
    x = centres.repeat_interleave(100, 0) + torch.randn(400, 2, generator=g)
    centroids = torch.tensor([[0.5, 0.0], [-0.5, 0.0], [55.0, 0.0], [0.0, 90.0]])
    # Ten times as many centroids far away, so that a tenth of them is one.
    far = torch.arange(20.0)[:, None] * 1000 + 5000
    x = torch.cat([x, (far + torch.zeros(20, 2)).repeat(2, 1)])
    x, centroids = x.double(), torch.cat([centroids, far + torch.zeros(20, 2)]).double()
    index, cost, second = find_nearest(x, centroids, with_second=True)
    assert second is not None
    means, _ = cluster_means(x, index, centroids)
    moved, moves = relocate(x, index, cost, second, means)
    assert int(moves) == 1
    torch.testing.assert_close(
        torch.cdist(centres.double(), moved).amin(1), torch.zeros(4).double(), atol=1.0, rtol=0
    )


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    distinct=st.integers(1, 30),
    copies=st.integers(1, 6),
    clusters=st.integers(1, 30),
    num_iterations=st.integers(1, 6),
)
def test_no_empty_clusters_with_duplicates(
    seed: int, distinct: int, copies: int, clusters: int, num_iterations: int
) -> None:
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(distinct, 3, generator=g).repeat(copies, 1)
    if clusters > distinct:
        with pytest.raises(ValueError, match=f"cannot make {clusters} clusters of"):
            kmeans(x, clusters, num_iterations, seed)
        return
    result = kmeans(x, clusters, num_iterations, seed)
    assert (result.assignment.bincount(minlength=clusters) > 0).all()
    # Equal points share a cluster, so with as many clusters as distinct points each has one of its own.
    by_point = result.assignment.view(copies, distinct)
    assert (by_point == by_point[0]).all()


def test_fill_empty_clusters() -> None:
    x = torch.tensor([[0.0], [0.0], [1.0], [5.0], [9.0]])
    centroids = torch.tensor([[0.5], [100.0], [200.0]])
    filled, assignment, cost = fill_empty_clusters(x, torch.zeros(5, dtype=torch.int64), centroids)
    # 9 is farthest from 0.5; after that 5, which is not nearer to 9 than to 0.5 by less.
    assert filled[:, 0].tolist() == [0.5, 9.0, 5.0]
    assert assignment.tolist() == [0, 0, 0, 2, 1]
    assert cost.tolist() == [0.25, 0.25, 0.25, 0.0, 0.0]


def test_initial_centroids_are_distinct_points() -> None:
    x = mixture(1000, 8, 20, 0.5)
    initial = draw_initial(x, 150, torch.Generator().manual_seed(0))
    assert initial.shape == (150, 8)
    assert (exact_costs(initial, x).amin(1) == 0).all()
    assert initial.unique(dim=0).shape[0] == 150


def test_progress_and_early_stop() -> None:
    x = mixture(3000, 8, 50, 0.5)
    seen: list[tuple[int, float]] = []
    result = kmeans(x, 50, num_iterations=100, tolerance=1e-3, progress=lambda i, e: seen.append((i, e)))
    assert [i for i, _ in seen] == list(range(1, result.num_iterations + 1))
    assert result.num_iterations < 40
    assert seen[-1][1] < 0.9 * seen[0][1]
    assert result.inertia.item() <= seen[-1][1] * 1.0001
    assert kmeans(x, 50, num_iterations=1).num_iterations == 1


def test_one_cluster_and_as_many_as_points() -> None:
    x = mixture(50, 4, 5, 0.5).double()
    torch.testing.assert_close(kmeans(x, 1).centroids[0], x.mean(0))
    every = kmeans(x, 50)
    assert every.inertia.item() == 0.0
    assert every.assignment.unique().shape[0] == 50


def test_visual_words() -> None:
    x = mixture(2000, 8, 30, 0.5).requires_grad_()
    words = VisualWords(num_words=40, num_iterations=7, seed=5)(x)
    assert torch.equal(words, kmeans(x, 40, num_iterations=7, seed=5).centroids)
    assert not words.requires_grad
    with pytest.raises(ValueError, match="got 0 and 25"):
        VisualWords(num_words=0)


def test_bad_input() -> None:
    x = torch.randn(10, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="cannot make 11 clusters of 10 points"):
        kmeans(x, 11)
    with pytest.raises(ValueError, match=r"\(N, d\), got \(10,\) torch\.float32"):
        kmeans(x[:, 0], 2)
    with pytest.raises(ValueError, match=r"got \(10, 3\) torch\.int64"):
        kmeans(x.long(), 2)
    with pytest.raises(ValueError, match="at least 1, got 2 and 0"):
        kmeans(x, 2, num_iterations=0)
    with pytest.raises(ValueError, match="NaN"):
        kmeans(x.where(x < x.max(), torch.nan), 2)

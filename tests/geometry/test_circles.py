from itertools import combinations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from foundpose.geometry.circles import smallest_enclosing_circles


def brute_force(points):
    """Of the circles on all pairs and through all triples, the smallest that holds all points."""
    circles = [((a + b) / 2, np.linalg.norm(a - b) / 2) for a, b in combinations(points, 2)]
    for a, b, c in combinations(points, 3):
        # The centre is where two perpendicular bisectors meet.
        normals = 2 * np.stack([b - a, c - a])
        if abs(np.linalg.det(normals)) > 1e-9:
            centre = np.linalg.solve(normals, [b @ b - a @ a, c @ c - a @ a])
            circles.append((centre, np.linalg.norm(centre - a)))
    holding = [c for c in circles if (np.linalg.norm(points - c[0], axis=1) <= c[1] + 1e-9).all()]
    return min(holding, key=lambda circle: circle[1])


def test_equals_brute_force_on_random_points(rng):
    points = rng.normal(size=(60, 12, 2)) * rng.uniform(0.1, 300, (60, 1, 2))
    found = smallest_enclosing_circles(torch.from_numpy(points))
    for i in range(60):
        centre, radius = brute_force(points[i])
        np.testing.assert_allclose(found.centre[i], centre, atol=1e-8)
        np.testing.assert_allclose(found.radius[i], radius, atol=1e-8)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), min_size=2, max_size=9))
@example([(-4, -1), (3, -3), (-3, 3), (4, 1)])  # two diameters that cross in the middle
def test_equals_brute_force_on_grids_with_duplicates_lines_and_ties(points):
    points = np.array(points, dtype=float)
    found = smallest_enclosing_circles(torch.from_numpy(points)[None])
    centre, radius = brute_force(points)
    np.testing.assert_allclose(found.centre[0], centre, atol=1e-7)
    np.testing.assert_allclose(found.radius[0], radius, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_opencv_on_many_points(rng, dtype):
    # OpenCV works in float32 and adds a little to its radius.
    discs = [rng.uniform(-1, 1, (4000, 2)) for _ in range(4)]
    clouds = [
        1000 + 80 * d[np.linalg.norm(d, axis=1) < 1] * s
        for d, s in zip(discs, (1, 0.5, 2, 0.01), strict=True)
    ]
    most = max(len(c) for c in clouds)
    points = torch.zeros(4, most, 2, dtype=dtype)
    valid = torch.zeros(4, most, dtype=torch.bool)
    for i, cloud in enumerate(clouds):
        points[i, : len(cloud)] = torch.from_numpy(cloud)
        valid[i, : len(cloud)] = True
    found = smallest_enclosing_circles(points, valid)
    for i, cloud in enumerate(clouds):
        centre, radius = cv2.minEnclosingCircle(cloud.astype(np.float32))
        np.testing.assert_allclose(found.centre[i], centre, atol=2e-3)
        np.testing.assert_allclose(found.radius[i], radius, atol=2e-3)
        # Nothing is outside.
        distance = (points[i, valid[i]] - found.centre[i]).norm(dim=1)
        assert (
            distance.max()
            <= found.radius[i] * (1 + 10 * torch.finfo(dtype).eps) + 1e3 * torch.finfo(dtype).eps
        )


def test_points_that_do_not_exist_and_neighbours_change_nothing(generator):
    points = torch.randn(5, 30, 2, generator=generator)
    valid = torch.rand(5, 30, generator=generator) < 0.5
    together = smallest_enclosing_circles(torch.where(valid[..., None], points, torch.nan), valid)
    for i in range(5):
        alone = smallest_enclosing_circles(points[i : i + 1, valid[i]])
        assert torch.equal(alone.centre[0], together.centre[i])
        assert torch.equal(alone.radius[0], together.radius[i])


def test_one_point_and_none():
    points = torch.tensor(
        [[[3.0, 4.0], [9.0, 9.0]], [[1.0, 2.0], [torch.inf, 0.0]], [[1.0, 2.0], [5.0, 0.0]]]
    )
    found = smallest_enclosing_circles(points, torch.tensor([[True, False], [True, True], [False, False]]))
    assert found.valid.tolist() == [True, True, False]
    assert found.centre.tolist() == [[3.0, 4.0], [1.0, 2.0], [0.0, 0.0]]
    assert found.radius.tolist() == [0.0, 0.0, 0.0]
    empty = smallest_enclosing_circles(torch.zeros(2, 0, 2))
    assert not empty.valid.any()
    assert empty.centre.shape == (2, 2)


def test_gradients(generator):
    points = torch.randn(6, 8, 2, generator=generator, dtype=torch.float64)
    points[3, 1:] = points[3, 0]  # a single point, many times
    points[4, 2:] = points[4, :2].mean(0)  # a pair
    moving = points[[0, 1, 2, 4, 5]].requires_grad_()
    assert torch.autograd.gradcheck(lambda p: smallest_enclosing_circles(p)[:2], (moving,))
    single = points[3:4].clone().requires_grad_()
    found = smallest_enclosing_circles(single)
    (found.centre.sum() + found.radius.sum()).backward()
    torch.testing.assert_close(single.grad.sum(dim=(0, 1)), torch.ones(2, dtype=torch.float64))


def test_bad_input():
    with pytest.raises(ValueError, match=r"points must have shape \(B, N, 2\), got \(4, 2\)"):
        smallest_enclosing_circles(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"valid must be bool of shape \(1, 4\), got \(1, 3\)"):
        smallest_enclosing_circles(torch.zeros(1, 4, 2), torch.ones(1, 3, dtype=torch.bool))

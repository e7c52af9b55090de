from functools import cache

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry.transforms import transform_points
from foundpose.pnp import PnpProblem
from foundpose.pnp.p3p import P3PSolutions, solve_p3p, solve_p3p_minimal, solve_p3p_rays
from tests.pnp.scenes import Scene, make_scene, stack

SHAPES = ["volume", "ellipsoid", "plane"]
DTYPES = [torch.float32, torch.float64]


@cache
def scenes_of(count: int, shape: str = "volume", wide: bool = False, seed: int = 0) -> list[Scene]:
    rng = np.random.default_rng(seed)
    return [make_scene(rng, 3, shape, wide) for _ in range(count)]


def distances(T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
    """The larger of rotation angle and relative translation, between poses (..., 4, 4)."""
    chord = np.linalg.norm(T_a[..., :3, :3] - T_b[..., :3, :3], axis=(-1, -2)) / np.sqrt(8.0)
    angle = 2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))
    shift = np.linalg.norm(T_a[..., :3, 3] - T_b[..., :3, 3], axis=-1)
    return np.maximum(angle, shift / np.linalg.norm(T_b[..., :3, 3], axis=-1))


def true_root_errors(solutions: P3PSolutions, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Error of the valid root nearest to the truth; infinite without valid roots."""
    truth = np.zeros((len(R), 1, 4, 4))
    truth[:, 0, :3, :3], truth[:, 0, :3, 3] = R, t
    errors = distances(solutions.T_camera_from_model.detach().double().numpy(), truth)
    return np.where(solutions.valid.numpy(), errors, np.inf).min(1)


def scene_errors(solutions: P3PSolutions, scenes: list[Scene]) -> np.ndarray:
    return true_root_errors(solutions, np.stack([s.R for s in scenes]), np.stack([s.t for s in scenes]))


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_recovers_known_poses(shape: str, wide: bool) -> None:
    scenes = scenes_of(1000, shape, wide)
    image, model, K, _ = stack(scenes, torch.float64)
    solutions = solve_p3p(PnpProblem(image, model, K))
    assert not solutions.degenerate.any()
    assert (scene_errors(solutions, scenes) < 1e-6).all()


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(("shape", "share"), [("volume", 0.99), ("ellipsoid", 0.99), ("plane", 0.95)])
def test_float32(shape: str, share: float, wide: bool) -> None:
    """Points of a plane make thin triangles now and then, whose height their sides hardly tell."""
    scenes = scenes_of(1000, shape, wide)
    image, model, K, _ = stack(scenes, torch.float32)
    solutions = solve_p3p(PnpProblem(image, model, K))
    assert solutions.T_camera_from_model.dtype == torch.float32
    errors = scene_errors(solutions, scenes)
    assert (errors < 1e-4).mean() >= share
    # The rounding of the input alone moves the poses by half as much.
    exact = solve_p3p(PnpProblem(image.double(), model.double(), K.double()))
    assert np.median(errors) < 3.0 * np.median(scene_errors(exact, scenes))


def opencv_roots(scene: Scene, flag: int) -> list[np.ndarray]:
    """Poses in front of the camera that bring the points to their pixels."""
    _, rotations, translations = cv2.solveP3P(scene.points_model, scene.points_image, scene.K, None, flag)
    roots = []
    for rotation, translation in zip(rotations or (), translations or (), strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(translation)
        camera = scene.points_model @ T[:3, :3].T + T[:3, 3]
        image = camera @ scene.K.T
        error = np.abs(image[:, :2] / image[:, 2:] - scene.points_image).max()
        if (camera[:, 2] > 0).all() and error < 1e-5:
            roots.append(T)
    return roots


@pytest.mark.parametrize("flag", [cv2.SOLVEPNP_P3P, cv2.SOLVEPNP_AP3P])
@pytest.mark.parametrize("mixed_up", [False, True])
@pytest.mark.parametrize("wide", [False, True])
def test_finds_all_roots_that_opencv_finds(wide: bool, mixed_up: bool, flag: int) -> None:
    """Also for pixels that have nothing to do with the points, as in RANSAC: there may be no root at all."""
    scenes = scenes_of(500, "volume", wide, seed=11)
    if mixed_up:
        rng = np.random.default_rng(1)
        scenes = [s._replace(points_image=rng.uniform(80, 340, (3, 2))) for s in scenes]
    image, model, K, _ = stack(scenes, torch.float64)
    solutions = solve_p3p(PnpProblem(image, model, K))
    counts = set()
    for scene, T, valid in zip(scenes, solutions.T_camera_from_model, solutions.valid, strict=True):
        ours, theirs = T[valid].numpy(), opencv_roots(scene, flag)
        counts.add(len(ours))
        # Of AP3P's roots a few are too inaccurate to count.
        assert len(ours) == len(theirs) or (flag == cv2.SOLVEPNP_AP3P and len(ours) > len(theirs))
        for root in theirs:
            assert distances(ours, root).min() < 1e-6
    assert counts >= ({0, 2} if mixed_up else {2, 4})


def test_equilateral_triangle_seen_along_its_axis() -> None:
    """The most symmetric case there is: the frontal pose, and three that tilt it towards a corner each."""
    angle = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    points = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=-1)
    K = np.diag([1000.0, 1000.0, 1.0])
    for depth in (0.5, 2.0, 6.0, 100.0):
        scene = Scene(points, points[:, :2] * 1000.0 / depth, K, np.eye(3), np.array([0.0, 0.0, depth]), 2.0)
        image, model, intrinsics, _ = stack([scene], torch.float64)
        solutions = solve_p3p(PnpProblem(image, model, intrinsics))
        assert scene_errors(solutions, [scene])[0] < 1e-9
        roots = solutions.T_camera_from_model[solutions.valid].numpy()
        for reference in opencv_roots(scene, cv2.SOLVEPNP_P3P):
            assert distances(roots, reference).min() < 1e-6


def danger_cylinder(count: int, offset: float) -> tuple[np.ndarray, ...]:
    """Triangles on a unit circle seen from the cylinder over it, where roots are double, or from beside it."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2.0 * np.pi, (count, 3))
    points = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    azimuth, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(1.0, 6.0, count)
    centre = np.stack([(1.0 + offset) * np.cos(azimuth), (1.0 + offset) * np.sin(azimuth), height], axis=-1)
    z = points.mean(1) - centre
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(rng.normal(size=(count, 3)), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    t = -np.einsum("nij,nj->ni", R, centre)
    camera = np.einsum("nij,nkj->nki", R, points) + t[:, None]
    return points, camera / camera[..., 2:], R, t


@pytest.mark.parametrize(("offset", "share"), [(0.0, 0.93), (1e-6, 0.98), (1e-4, 0.995), (1e-2, 0.999)])
def test_double_roots(offset: float, share: float) -> None:
    points, rays, R, t = danger_cylinder(5000, offset)
    inputs = [torch.from_numpy(x).requires_grad_() for x in (rays, points)]
    solutions = solve_p3p_rays(*inputs)
    assert (true_root_errors(solutions, R, t) < 1e-6).mean() >= share
    # A root that rounding has split or lost altogether still gives finite gradients.
    solutions.T_camera_from_model.square().sum().backward()
    for x in inputs:
        assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_triangle_seen_edge_on(dtype: torch.dtype) -> None:
    """Three pixels on a line are not degenerate: the plane of the points goes through the camera centre."""
    rng = np.random.default_rng(1)
    plane = rng.uniform(-0.5, 0.5, (1000, 3, 2))
    camera = np.stack([plane[..., 0], 0.0 * plane[..., 0], plane[..., 1] + 3.0], axis=-1)
    R, t = Rotation.random(1000, random_state=1).as_matrix(), np.array([0.1, -0.2, 3.0])
    points = np.einsum("nji,nkj->nki", R, camera - t)
    rays = camera / camera[..., 2:]
    solutions = solve_p3p_rays(torch.from_numpy(rays).to(dtype), torch.from_numpy(points).to(dtype))
    errors = true_root_errors(solutions, R, np.broadcast_to(t, (1000, 3)))
    assert (errors < (1e-7 if dtype == torch.float64 else 1e-3)).mean() >= 0.99


def on_rays(solutions: P3PSolutions, rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distances of all points from their rays, in sizes of the triangle and in distances; and depths."""
    T = solutions.T_camera_from_model.double()
    camera = points.double()[:, None] @ T[..., :3, :3].mT + T[..., None, :3, 3]
    bearing = torch.nn.functional.normalize(rays.double(), dim=-1)[:, None]
    off = torch.linalg.vector_norm(torch.linalg.cross(camera, bearing.expand_as(camera)), dim=-1)
    size = (points.double()[:, None] - points.double()[:, :, None]).norm(dim=-1).amax((-1, -2))
    return off / size[:, None, None], off / camera.norm(dim=-1), camera[..., 2]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-3), (torch.float64, 1e-8)])
@given(
    pixels=arrays(float, (4, 3, 2), elements=st.floats(-1000, 1000, width=32)),
    points=arrays(float, (4, 3, 3), elements=st.floats(-100, 100, width=32)),
    focal=st.floats(100, 5000),
)
@settings(max_examples=75)
def test_every_valid_root_reprojects(
    dtype: torch.dtype, tolerance: float, pixels: np.ndarray, points: np.ndarray, focal: float
) -> None:
    K = torch.tensor([[focal, 0.0, 200.0], [0.0, focal, 200.0], [0.0, 0.0, 1.0]], dtype=dtype).repeat(4, 1, 1)
    image, model = torch.from_numpy(pixels).to(dtype), torch.from_numpy(points).to(dtype)
    solutions = solve_p3p(PnpProblem(image, model, K))
    T, valid = solutions.T_camera_from_model, solutions.valid
    assert torch.isfinite(T).all()
    assert not (valid & solutions.degenerate[:, None]).any()
    gram = T[..., :3, :3].double().mT @ T[..., :3, :3].double()
    eye = torch.eye(3, dtype=torch.float64).expand_as(gram)
    torch.testing.assert_close(gram, eye, atol=1e-5 if dtype == torch.float32 else 1e-10, rtol=0)
    assert (torch.linalg.det(T[..., :3, :3]) > 0).all()
    rays = torch.nn.functional.pad((image.double() - 200.0) / K[0, 0, 0].double(), (0, 1), value=1.0)
    by_size, by_distance, depth = on_rays(solutions, rays, model)
    assert (depth[valid] > 0).all()
    rounding = 50.0 * torch.finfo(dtype).eps
    assert ((by_size < tolerance) | (by_distance < rounding))[valid].all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_valid_roots_come_first_by_distance(dtype: torch.dtype) -> None:
    scenes = scenes_of(2000, "ellipsoid", wide=True)
    image, model, K, _ = stack(scenes, dtype)
    T, valid, _ = solve_p3p(PnpProblem(image, model, K))
    assert not (valid[:, 1:] & ~valid[:, :-1]).any()
    camera = torch.einsum("brij,bj->bri", T[..., :3, :3], model[:, 0]) + T[..., :3, 3]
    distance = camera.norm(dim=-1)
    both = valid[:, 1:] & valid[:, :-1]
    assert both.sum() > 2000
    assert (distance[:, 1:] - distance[:, :-1] >= -1e-4 * distance[:, 1:])[both].all()
    assert (T[~valid] == torch.eye(4, dtype=dtype)).all()


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e6])
def test_unit_of_length_does_not_matter(unit: float) -> None:
    scenes = scenes_of(200)
    image, model, K, _ = stack(scenes, torch.float32)
    scaled = [s._replace(t=s.t * unit) for s in scenes]
    ours = scene_errors(solve_p3p(PnpProblem(image, model * unit, K)), scaled)
    assert (ours < 1e-4).mean() >= 0.99


def degenerate_batch(dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """One good sample, then eleven that determine no pose."""
    image, model, K, _ = stack(scenes_of(12, seed=3), dtype)
    line = torch.tensor([[-1.0], [0.3], [1.0]], dtype=dtype) * torch.tensor([50.0, -30.0, 20.0], dtype=dtype)
    model[1] = line + 3.0
    model[2] = 5.0
    model[3, 2] = model[3, 0]
    image[4] = 210.0
    image[5, 1] = image[5, 2]
    image[6, 0, 1] = torch.nan
    model[7, 2, 0] = torch.inf
    K[8] = torch.nan
    K[9, 0, 0] = 0.0
    K[10] = 1.0
    image[11], model[11], K[11] = 0.0, 0.0, 0.0
    return image, model, K


@pytest.mark.parametrize("dtype", DTYPES)
def test_degenerate_samples_are_flagged_among_good_ones(dtype: torch.dtype) -> None:
    inputs = degenerate_batch(dtype)
    clean = solve_p3p(PnpProblem(*(x[:1] for x in inputs)))
    inputs = tuple(x.requires_grad_() for x in inputs)
    T, valid, degenerate = solve_p3p(PnpProblem(*inputs))
    assert degenerate.tolist() == [False] + 11 * [True]
    assert not valid[1:].any()
    assert valid[0].any()
    assert torch.isfinite(T).all()
    assert torch.equal(T[:1], clean.T_camera_from_model)
    (T * torch.linspace(0.5, 2.0, T.numel(), dtype=dtype).view_as(T)).sum().backward()
    for x in inputs:
        assert torch.isfinite(x.grad).all()
        assert (x.grad[1:] == 0).all()
        assert (x.grad[0] != 0).any()


def test_rays_function_flags_unusable_rays() -> None:
    points, rays, _, _ = danger_cylinder(4, 0.5)
    rays, points = torch.from_numpy(rays), torch.from_numpy(points)
    rays[1, 0, 0], rays[2, 1, 1], points[3] = torch.nan, 1e30, 1e200
    solutions = solve_p3p_rays(rays.requires_grad_(), points.requires_grad_())
    assert solutions.degenerate.tolist() == [False, True, True, True]
    solutions.T_camera_from_model.sum().backward()
    assert torch.isfinite(rays.grad).all()
    assert torch.isfinite(points.grad).all()


@pytest.mark.parametrize(("shape", "wide"), [("volume", False), ("plane", True)])
def test_gradients_of_all_roots(shape: str, wide: bool) -> None:
    scenes = scenes_of(2, shape, wide, seed=5)
    image, model, K, _ = stack(scenes, torch.float64)
    # Units in which finite differences of one size suit all inputs.
    image, model, K = image / 100.0, model / 100.0, torch.diag(torch.tensor([0.01, 0.01, 1.0]).double()) @ K
    valid = solve_p3p(PnpProblem(image, model, K)).valid
    assert valid.any(1).all()

    def roots(image: Tensor, model: Tensor, intrinsics: Tensor) -> Tensor:
        K = torch.zeros(2, 3, 3, dtype=torch.float64)
        K[:, 0, 0], K[:, 1, 1], K[:, :2, 2], K[:, 2, 2] = *intrinsics[:, :2].T, intrinsics[:, 2:], 1.0
        return solve_p3p(PnpProblem(image, model, K)).T_camera_from_model[valid]

    intrinsics = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], dim=-1)
    inputs = [x.clone().requires_grad_() for x in (image, model, intrinsics)]
    assert torch.autograd.gradcheck(roots, inputs, eps=1e-7, atol=1e-5, rtol=1e-5)


def test_gradients_do_not_change_values() -> None:
    image, model, K, _ = stack(scenes_of(100), torch.float32)
    plain = solve_p3p(PnpProblem(image, model, K)).T_camera_from_model
    assert not plain.requires_grad
    assert torch.equal(solve_p3p(PnpProblem(image.requires_grad_(), model, K)).T_camera_from_model, plain)


@pytest.mark.parametrize("dtype", DTYPES)
def test_batch_independence(dtype: torch.dtype) -> None:
    """To the last bit."""
    image, model, K, _ = stack(scenes_of(33, wide=True), dtype)

    def solve(samples: slice) -> tuple[Tensor, ...]:
        inputs = [x[samples].clone().requires_grad_() for x in (image, model, K)]
        solutions = solve_p3p(PnpProblem(*inputs))
        grads = torch.autograd.grad(solutions.T_camera_from_model.square().sum(), inputs)
        return solutions.T_camera_from_model.detach(), solutions.valid, *grads[:2]

    T, valid, *grads = solve(slice(None))
    for size in (1, 5):
        parts = zip(*(solve(slice(i, i + size)) for i in range(0, 33, size)), strict=True)
        T_parts, valid_parts, *grad_parts = (torch.cat(part) for part in parts)
        assert torch.equal(T, T_parts)
        assert torch.equal(valid, valid_parts)
        # Autograd sums over broadcast dimensions in an order of its own.
        for whole, part in zip(grads, grad_parts, strict=True):
            torch.testing.assert_close(whole, part, rtol=1e3 * torch.finfo(dtype).eps, atol=0.0)


def test_empty_batch() -> None:
    solutions = solve_p3p(PnpProblem(torch.zeros(0, 3, 2), torch.zeros(0, 3, 3), torch.zeros(0, 3, 3)))
    assert solutions.T_camera_from_model.shape == (0, 4, 4, 4)
    assert solutions.valid.shape == (0, 4)
    assert solutions.degenerate.shape == (0,)


def test_bad_input() -> None:
    image, model, K, _ = stack(scenes_of(2), torch.float32)
    with pytest.raises(ValueError, match="exactly 3 correspondences, got N = 2"):
        solve_p3p(PnpProblem(image[:, :2], model[:, :2], K))
    with pytest.raises(ValueError, match=r"points_image must have shape \(B, N, 2\), got \(3, 2\)"):
        solve_p3p(PnpProblem(image[0], model, K))
    with pytest.raises(ValueError, match=r"points_model must have shape \(2, 3, 3\), got \(1, 3, 3\)"):
        solve_p3p(PnpProblem(image, model[:1], K))
    with pytest.raises(ValueError, match=r"K must have shape \(2, 3, 3\).*got \(3, 3\)"):
        solve_p3p(PnpProblem(image, model, K[0]))
    with pytest.raises(ValueError, match="float64"):
        solve_p3p(PnpProblem(image, model.double(), K))


def test_the_fourth_correspondence_chooses_the_root() -> None:
    generator = torch.Generator().manual_seed(4)
    model = torch.randn(500, 4, 3, generator=generator, dtype=torch.float64)
    rays = torch.rand(500, 4, 3, generator=generator, dtype=torch.float64) - 0.5
    rays[..., 2] = 1.0
    every = solve_p3p_rays(rays[:, :3], model[:, :3])
    fourth = transform_points(every.T_camera_from_model, model[:, None, 3:]).squeeze(-2)
    ahead = every.valid & (fourth[..., 2] > 0)
    error = torch.linalg.vector_norm(fourth[..., :2] / fourth[..., 2:] - rays[:, 3:, :2], dim=-1)
    best = error.masked_fill(~ahead, torch.inf).argmin(1)
    one = solve_p3p_minimal(rays, model)
    assert torch.equal(one.valid, ahead.any(1))
    assert 100 < one.valid.sum() < 500
    expected = every.T_camera_from_model[torch.arange(500), best]
    torch.testing.assert_close(one.T_camera_from_model[one.valid], expected[one.valid])

import cv2
import numpy as np
import pytest
import torch

from foundpose.pnp import polish_pnp, solve_epnp
from tests.pnp.scenes import make_scene, pose_errors, stack

SHAPES = ["volume", "ellipsoid", "plane"]


def scenes_of(count: int, points: int, shape: str, wide: bool, seed: int = 0):
    rng = np.random.default_rng(seed)
    return [make_scene(rng, points, shape, wide) for _ in range(count)]


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [6, 20])
def test_recovers_known_poses(points: int, shape: str, wide: bool) -> None:
    scenes = scenes_of(200, points, shape, wide)
    image, model, K, _ = stack(scenes, torch.float64)
    solution = solve_epnp(image, model, K)
    angle, distance = pose_errors(solution.T_camera_from_model, scenes)
    assert solution.valid.all()
    assert not solution.degenerate.any()
    assert np.radians(angle).max() < 1e-6
    assert distance.max() < 1e-6


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [4, 5])
def test_recovers_known_poses_from_four_and_five_points(points: int, shape: str, wide: bool) -> None:
    scenes = scenes_of(300, points, shape, wide)
    image, model, K, _ = stack(scenes, torch.float64)
    solution = solve_epnp(image, model, K)
    T = polish_pnp(solution.T_camera_from_model, image, model, K, max_iterations=20)[0].T
    angle, distance = pose_errors(T, scenes)
    assert ((np.radians(angle) < 1e-6) & (distance < 1e-6)).mean() >= 0.95


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [4, 6, 30])
def test_float32(points: int, shape: str) -> None:
    scenes = scenes_of(200, points, shape, False)
    image, model, K, _ = stack(scenes, torch.float32)
    solution = solve_epnp(image, model, K)
    assert solution.T_camera_from_model.dtype == torch.float32
    angle, distance = pose_errors(solution.T_camera_from_model, scenes)
    assert ((angle < 0.5) & (distance < 2e-3)).mean() >= 0.9
    T = polish_pnp(solution.T_camera_from_model, image, model, K, max_iterations=20)[0].T
    angle, distance = pose_errors(T, scenes)
    assert ((angle < 0.01) & (distance < 1e-5)).mean() >= 0.95


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [4, 8])
def test_no_worse_than_opencvs_epnp_under_noise(points: int, shape: str) -> None:
    scenes = scenes_of(200, points, shape, False)
    rng = np.random.default_rng(1)
    scenes = [
        s._replace(points_image=s.points_image + 1.5 * rng.normal(size=s.points_image.shape)) for s in scenes
    ]
    image, model, K, _ = stack(scenes, torch.float32)
    ours, _ = pose_errors(solve_epnp(image, model, K).T_camera_from_model, scenes)
    reference = []
    for s in scenes:
        _, rotation, translation = cv2.solvePnP(
            s.points_model, s.points_image, s.K, None, flags=cv2.SOLVEPNP_EPNP
        )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        reference.append(T)
    theirs, _ = pose_errors(torch.from_numpy(np.nan_to_num(np.stack(reference))), scenes)
    assert (ours < 5.0).mean() >= (theirs < 5.0).mean()
    assert np.median(ours) < 1.05 * np.median(theirs)


def test_weights_select_a_subset() -> None:
    scenes = scenes_of(50, 12, "volume", False)
    image, model, K, _ = stack(scenes, torch.float64)
    subset = solve_epnp(image[:, :7], model[:, :7], K)
    image[:, 7:] += 50.0
    image[0, 8], model[1, 9] = torch.nan, torch.inf
    weights = torch.zeros(50, 12, dtype=torch.float64)
    weights[:, :7] = 3.0
    for w in (weights, weights > 0):
        masked = solve_epnp(image, model, K, w)
        assert masked.valid.all()
        torch.testing.assert_close(
            masked.T_camera_from_model, subset.T_camera_from_model, rtol=1e-7, atol=1e-6
        )
    # Four weighted points among padding are solved as well.
    weights[:, 4:] = 0.0
    four = solve_epnp(image, model, K, weights)
    T = polish_pnp(
        four.T_camera_from_model,
        image.nan_to_num(),
        model.nan_to_num(posinf=0.0),
        K,
        weights,
        max_iterations=20,
    )[0].T
    assert (pose_errors(T, scenes)[0] < 1e-4).mean() >= 0.95


def test_weights_downweight() -> None:
    scenes = scenes_of(100, 30, "volume", False)
    rng = np.random.default_rng(2)
    sigma = np.where(np.arange(30) < 10, 0.1, 5.0)
    scenes = [
        s._replace(points_image=s.points_image + sigma[:, None] * rng.normal(size=(30, 2))) for s in scenes
    ]
    image, model, K, _ = stack(scenes, torch.float64)
    weights = torch.from_numpy(sigma**-2.0).expand(100, 30)
    plain, _ = pose_errors(solve_epnp(image, model, K).T_camera_from_model, scenes)
    weighted, _ = pose_errors(solve_epnp(image, model, K, weights).T_camera_from_model, scenes)
    assert np.median(weighted) < 0.2 * np.median(plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("points", [4, 5, 9])
def test_degenerate_samples_are_flagged_among_good_ones(points: int, dtype: torch.dtype) -> None:
    image, model, K, _ = stack(scenes_of(7, points, "volume", False), dtype)
    clean = solve_epnp(image, model, K)
    line = torch.linspace(-1, 1, points, dtype=dtype)[:, None] * torch.tensor(
        [50.0, -30.0, 20.0], dtype=dtype
    )
    model[1] = line + 3.0
    model[2] = 5.0
    image[3, 0] = torch.nan
    model[4] = 0.0
    image[4] = 0.0
    if points == 4:
        model[5, 3] = model[5, 1]
    weights = torch.ones(7, points, dtype=dtype)
    weights[6, 3:] = 0.0
    solution = solve_epnp(image, model, K, weights)
    assert torch.isfinite(solution.T_camera_from_model).all()
    expected = [False, True, True, points == 4, True, points == 4, True]
    assert solution.degenerate.tolist() == expected
    assert not (solution.valid & solution.degenerate).any()
    torch.testing.assert_close(solution.T_camera_from_model[0], clean.T_camera_from_model[0])


@pytest.mark.parametrize("points", [4, 8])
def test_points_behind_the_camera_are_never_valid(points: int) -> None:
    """Images of points behind the camera look like images of mirrored objects; no valid pose explains them."""
    scenes = scenes_of(200, points, "volume", True)
    image, model, K, _ = stack([s._replace(points_image=419 - s.points_image) for s in scenes], torch.float64)
    solution = solve_epnp(image, model, K)
    camera = model @ solution.T_camera_from_model[:, :3, :3].mT + solution.T_camera_from_model[:, None, :3, 3]
    assert (camera[solution.valid][..., 2] > 0).all()


def test_batch_independence() -> None:
    scenes = scenes_of(20, 9, "volume", False)
    image, model, K, _ = stack(scenes, torch.float64)
    for n in (4, 9):
        together = solve_epnp(image[:, :n], model[:, :n], K).T_camera_from_model
        alone = torch.cat(
            [
                solve_epnp(image[i : i + 1, :n], model[i : i + 1, :n], K[i : i + 1]).T_camera_from_model
                for i in range(20)
            ]
        )
        torch.testing.assert_close(alone, together, rtol=1e-8, atol=1e-7)


def test_skewed_camera_with_two_focal_lengths() -> None:
    scenes = scenes_of(50, 8, "volume", True)
    skewed = []
    for s in scenes:
        K = s.K * np.array([[1.0, 1.0, 1.0], [1.0, 1.3, 1.0], [1.0, 1.0, 1.0]])
        K[0, 1] = 4.0
        image = (s.points_model @ s.R.T + s.t) @ K.T
        skewed.append(s._replace(K=K, points_image=image[:, :2] / image[:, 2:]))
    image, model, K, _ = stack(skewed, torch.float64)
    T = solve_epnp(image, model, K).T_camera_from_model
    angle, _ = pose_errors(T, scenes)
    assert angle.max() < 1e-5
    polished = polish_pnp(T, image, model, K)[0]
    assert pose_errors(polished.T, scenes)[0].max() < 1e-9


def test_gradients_are_finite() -> None:
    image, model, K, _ = stack(scenes_of(10, 8, "volume", False), torch.float64)
    for n in (4, 8):
        inputs = [x.clone().requires_grad_() for x in (image[:, :n], model[:, :n], K)]
        solve_epnp(*inputs).T_camera_from_model.square().sum().backward()
        for x in inputs:
            assert torch.isfinite(x.grad).all()
            assert x.grad.abs().max() > 0


def test_bad_input() -> None:
    image, model, K, _ = stack(scenes_of(2, 6, "volume", False), torch.float32)
    with pytest.raises(ValueError, match="at least 4 correspondences, got N = 3"):
        solve_epnp(image[:, :3], model[:, :3], K)
    with pytest.raises(ValueError, match=r"points_model must have shape \(2, 6, 3\), got \(2, 5, 3\)"):
        solve_epnp(image, model[:, :5], K)
    with pytest.raises(ValueError, match=r"K must have shape \(2, 3, 3\).*got \(3, 3\)"):
        solve_epnp(image, model, K[0])
    with pytest.raises(ValueError, match=r"weights must have shape \(2, 6\)"):
        solve_epnp(image, model, K, torch.ones(2, 5))
    with pytest.raises(ValueError, match="float16"):
        solve_epnp(image.half(), model.half(), K.half())

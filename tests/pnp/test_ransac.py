import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from foundpose.optimization import Huber
from foundpose.pnp import LevenbergMarquardtPnp, PnpProblem, PnpStatus, RansacPnp, solve_epnp
from foundpose.pnp.sampling import distinct_ranks
from tests.pnp.scenes import Scene, make_scene, pose_errors, stack

SHAPES = ["volume", "ellipsoid", "plane"]
OUTLIERS = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]


def spoil(scene: Scene, rng: np.random.Generator, outliers: float, noise: float) -> Scene:
    """Add pixel noise, and replace a share of the image points by random ones over the object."""
    image = scene.points_image + noise * rng.normal(size=scene.points_image.shape)
    low, high = image.min(0), image.max(0)
    wrong = rng.permutation(len(image))[: round(outliers * len(image))]
    image[wrong] = rng.uniform(low, high, (len(wrong), 2))
    return scene._replace(points_image=image)


def random_scenes(count: int, seed: int) -> list[Scene]:
    rng = np.random.default_rng(seed)
    scenes = []
    for i in range(count):
        size = int(rng.choice([30, 60, 100, 200, 300]))
        scene = make_scene(rng, size, SHAPES[i % 3], wide=bool(i // 24 % 2))
        scenes.append(spoil(scene, rng, OUTLIERS[i % 8], rng.uniform(1.0, 2.0)))
    return scenes


def opencv_pose(scene: Scene) -> np.ndarray:
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        scene.points_model,
        scene.points_image,
        scene.K,
        None,
        iterationsCount=400,
        reprojectionError=10.0,
        flags=cv2.SOLVEPNP_EPNP,
    )
    T = np.eye(4)
    if found:
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return T


def test_no_worse_than_opencv_on_random_problems() -> None:
    """576 problems, 0 to 70 % outliers, 30 to 300 points: success at 5° and 5 % of the distance."""
    scenes = random_scenes(576, seed=1)
    reference = torch.from_numpy(np.stack([opencv_pose(s) for s in scenes]))
    ransac = RansacPnp()
    ours = torch.cat(
        [
            ransac(PnpProblem(*stack(scenes[i : i + 48], torch.float32))).T_camera_from_model
            for i in range(0, 576, 48)
        ]
    )

    def success(T: torch.Tensor) -> np.ndarray:
        angle, distance = pose_errors(T, scenes)
        return (angle < 5.0) & (distance < 0.05)

    mine, theirs = success(ours), success(reference)
    assert mine.mean() >= theirs.mean() - 0.02
    for group in [np.arange(576) % 8 == k for k in range(8)] + [np.arange(576) % 3 == k for k in range(3)]:
        assert mine[group].mean() >= theirs[group].mean() - 0.02
    assert mine.mean() >= 0.95


def test_result_is_consistent_with_its_pose() -> None:
    scenes = random_scenes(24, seed=2)
    image, model, K, valid = stack(scenes, torch.float64)
    result = RansacPnp()(PnpProblem(image, model, K, valid))
    assert result.success.all()
    assert (result.status == PnpStatus.OK).all()
    for b, scene in enumerate(scenes):
        T, n = result.T_camera_from_model[b].numpy(), len(scene.points_model)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        rotation = cv2.Rodrigues(T[:3, :3])[0]
        projected = cv2.projectPoints(scene.points_model, rotation, T[:3, 3], scene.K, None)[0][:, 0]
        error = np.linalg.norm(projected - scene.points_image, axis=1)
        inliers = result.inliers[b].numpy()
        np.testing.assert_array_equal(inliers[:n], error <= 10.0)
        assert not inliers[n:].any()
        assert result.num_inliers[b] == inliers.sum()
        rmse = np.sqrt((error[error <= 10.0] ** 2).mean())
        assert result.reprojection_rmse[b].item() == pytest.approx(rmse, rel=1e-6)


def test_pose_is_scipys_optimum_on_the_inliers() -> None:
    scenes = random_scenes(16, seed=3)
    result = RansacPnp(polish_rounds=10)(PnpProblem(*stack(scenes, torch.float64)))
    for b, scene in enumerate(scenes):
        chosen = result.inliers[b, : len(scene.points_model)].numpy()
        model, image = scene.points_model[chosen], scene.points_image[chosen]

        def residuals(x: np.ndarray, model=model, image=image, scene=scene) -> np.ndarray:
            R = Rotation.from_rotvec(x[:3]).as_matrix() @ scene.R
            projected = (model @ R.T + scene.t + x[3:] * scene.diameter) @ scene.K.T
            return (projected[:, :2] / projected[:, 2:] - image).ravel()

        reference = least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        T = result.T_camera_from_model[b].numpy()
        R = Rotation.from_rotvec(reference.x[:3]).as_matrix() @ scene.R
        np.testing.assert_allclose(T[:3, :3], R, atol=1e-4)
        np.testing.assert_allclose(T[:3, 3], scene.t + reference.x[3:] * scene.diameter, rtol=1e-4, atol=0.02)
        rmse = np.sqrt(2.0 * reference.cost / len(image))
        assert result.reprojection_rmse[b].item() == pytest.approx(rmse, rel=1e-7)


@pytest.mark.parametrize("confidence", [None, 0.99])
def test_a_problem_alone_equals_the_problem_in_a_batch_with_padding(confidence: float | None) -> None:
    scenes = random_scenes(12, seed=4)
    image, model, K, valid = stack(scenes, torch.float32)
    ransac = RansacPnp(confidence=confidence)
    together = ransac(PnpProblem(image, model, K, valid))
    for b, scene in enumerate(scenes):
        n = len(scene.points_model)
        alone = ransac(PnpProblem(image[b : b + 1, :n], model[b : b + 1, :n], K[b : b + 1]))
        assert torch.equal(alone.inliers[0], together.inliers[b, :n])
        # Translations relative to the distance: across the line of sight they may be zero.
        poses = torch.stack([alone.T_camera_from_model[0], together.T_camera_from_model[b]])
        poses[:, :3, 3] /= poses[1, :3, 3].norm()
        torch.testing.assert_close(poses[0, :3, :3], poses[1, :3, :3], rtol=0.0, atol=1e-4)
        torch.testing.assert_close(poses[0, :3, 3], poses[1, :3, 3], rtol=0.0, atol=5e-6)
    # Validity scattered over the points instead of in front: the same correspondences in the same order.
    place = torch.arange(image.shape[1]) * 2 + 1
    wide_image = torch.full((12, 2 * image.shape[1] + 3, 2), torch.nan)
    wide_model = torch.full((12, 2 * image.shape[1] + 3, 3), torch.inf)
    wide_valid = torch.zeros(12, 2 * image.shape[1] + 3, dtype=torch.bool)
    wide_image[:, place], wide_model[:, place], wide_valid[:, place] = image, model, valid
    scattered = ransac(PnpProblem(wide_image, wide_model, K, wide_valid))
    assert torch.equal(scattered.inliers[:, place], together.inliers)


def test_seed_decides_and_nothing_else() -> None:
    inputs = stack(random_scenes(8, seed=5), torch.float32)
    first = RansacPnp(polish_rounds=0, seed=3)(PnpProblem(*inputs))
    torch.manual_seed(99)
    second = RansacPnp(polish_rounds=0, seed=3)(PnpProblem(*inputs))
    other = RansacPnp(polish_rounds=0, seed=4)(PnpProblem(*inputs))
    assert torch.equal(first.T_camera_from_model, second.T_camera_from_model)
    assert torch.equal(first.inliers, second.inliers)
    assert not torch.equal(first.T_camera_from_model, other.T_camera_from_model)


@pytest.mark.parametrize("confidence", [None, 0.9999])
def test_chunk_does_not_matter(confidence: float | None) -> None:
    inputs = stack(random_scenes(8, seed=6), torch.float64)
    results = [
        RansacPnp(iterations=150, confidence=confidence, chunk=chunk)(PnpProblem(*inputs))
        for chunk in (None, 1, 37, 50, 1000)
    ]
    for result in results[1:]:
        assert torch.equal(result.inliers, results[0].inliers)
        torch.testing.assert_close(result.T_camera_from_model, results[0].T_camera_from_model)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_failures_are_flagged_among_good_problems(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(7)
    scenes = [spoil(make_scene(rng, 40, "volume"), rng, 0.2, 1.0) for _ in range(8)]
    image, model, K, valid = stack(scenes, dtype)
    ransac = RansacPnp(min_inliers=15)
    clean = ransac(PnpProblem(image, model, K, valid))
    assert clean.success.all()
    valid[1, 3:] = False
    valid[2] = False
    line = torch.linspace(-50, 50, 40, dtype=dtype)[:, None]
    model[3] = line * torch.tensor([1.0, 2.0, -1.0], dtype=dtype)
    model[4] = 7.0
    image[5] = torch.from_numpy(rng.uniform(80.0, 340.0, (40, 2))).to(dtype)
    K[6] = 0.0
    image[7] = torch.nan
    result = ransac(PnpProblem(image, model, K, valid))
    assert result.status.tolist() == [
        PnpStatus.OK,
        PnpStatus.TOO_FEW_CORRESPONDENCES,
        PnpStatus.TOO_FEW_CORRESPONDENCES,
        PnpStatus.DEGENERATE,
        PnpStatus.DEGENERATE,
        PnpStatus.TOO_FEW_INLIERS,
        PnpStatus.DEGENERATE,
        PnpStatus.TOO_FEW_CORRESPONDENCES,
    ]
    assert result.success.tolist() == [True] + [False] * 7
    assert torch.isfinite(result.T_camera_from_model).all()
    assert (result.T_camera_from_model[:, 2, 3] > 0).all()
    assert 4 <= result.num_inliers[5] < 15
    assert (result.num_inliers[[1, 2, 3, 4, 6, 7]] == 0).all()
    torch.testing.assert_close(
        result.T_camera_from_model[0], clean.T_camera_from_model[0], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("pixels", [0.0, 1e-40, 1e10, 1e37])
@pytest.mark.parametrize("lengths", [0.0, 1e-40, 1e10, 1e37])
def test_absurd_numbers_neither_raise_nor_spread(dtype: torch.dtype, pixels: float, lengths: float) -> None:
    rng = np.random.default_rng(15)
    scene = make_scene(rng, 20, "volume")
    image, model, K, _ = stack([scene, scene], dtype)
    image[1] = (image[1] - 200.0) * pixels
    model[1] *= lengths
    for T in (
        RansacPnp(iterations=20)(PnpProblem(image, model, K)).T_camera_from_model,
        solve_epnp(PnpProblem(image, model, K)).T_camera_from_model,
        solve_epnp(PnpProblem(image[:, :4], model[:, :4], K)).T_camera_from_model,
    ):
        assert torch.isfinite(T).all()
        assert pose_errors(T[:1], [scene])[0] < 0.1


def test_points_behind_the_camera_are_not_inliers() -> None:
    rng = np.random.default_rng(8)
    scene = make_scene(rng, 30, "volume", wide=True)
    # Ten more points whose images are right but which lie behind the camera.
    behind = np.array([0.0, 0.0, -2.0 * scene.t[2]]) + rng.uniform(-40, 40, (10, 3))
    image = behind @ scene.K.T
    scene = scene._replace(
        points_model=np.concatenate([scene.points_model, (behind - scene.t) @ scene.R]),
        points_image=np.concatenate([scene.points_image, image[:, :2] / image[:, 2:]]),
    )
    result = RansacPnp()(PnpProblem(*stack([scene], torch.float64)))
    assert result.inliers[0].tolist() == [True] * 30 + [False] * 10
    assert pose_errors(result.T_camera_from_model, [scene])[0].max() < 1e-6


def test_many_matches_to_one_model_point() -> None:
    """Query patches may share their nearest template patch: two thirds of the matches repeat 3D points."""
    rng = np.random.default_rng(9)
    scenes = []
    for _ in range(20):
        scene = spoil(make_scene(rng, 90, "ellipsoid"), rng, 0.0, 1.0)
        model = scene.points_model.copy()
        model[30:] = model[rng.integers(0, 5, 60)]
        scenes.append(scene._replace(points_model=model))
    result = RansacPnp()(PnpProblem(*stack(scenes, torch.float32)))
    angle, distance = pose_errors(result.T_camera_from_model, scenes)
    assert result.success.all()
    assert ((angle < 5.0) & (distance < 0.05)).mean() >= 0.9


def test_minimal_number_of_correspondences() -> None:
    rng = np.random.default_rng(10)
    scenes = [make_scene(rng, 4, "volume", wide=True) for _ in range(20)]
    result = RansacPnp(min_inliers=4)(PnpProblem(*stack(scenes, torch.float64)))
    assert result.success.all()
    assert (pose_errors(result.T_camera_from_model, scenes)[0] < 1e-3).mean() >= 0.95
    assert not RansacPnp(min_inliers=5)(PnpProblem(*stack(scenes, torch.float64))).success.any()


def test_robust_polish_resists_outliers_within_the_threshold() -> None:
    rng = np.random.default_rng(11)
    scenes = []
    for _ in range(40):
        scene = spoil(make_scene(rng, 100, "volume"), rng, 0.0, 0.3)
        image = scene.points_image.copy()
        image[:30] += np.array([6.0, 2.0])
        scenes.append(scene._replace(points_image=image))
    inputs = stack(scenes, torch.float64)
    plain = pose_errors(RansacPnp()(PnpProblem(*inputs)).T_camera_from_model, scenes)[0]
    robust = pose_errors(
        RansacPnp(polish=LevenbergMarquardtPnp(Huber(0.5), max_iterations=10))(
            PnpProblem(*inputs)
        ).T_camera_from_model,
        scenes,
    )[0]
    assert np.median(robust) < 0.6 * np.median(plain)


def test_gradients_reach_points_and_intrinsics() -> None:
    image, model, K, valid = stack(random_scenes(8, seed=12), torch.float64)
    valid[3, 2:] = False
    inputs = [x.requires_grad_() for x in (image, model, K)]
    result = RansacPnp()(PnpProblem(*inputs, valid))
    result.T_camera_from_model[:, :3].square().sum().backward()
    for x in inputs:
        assert torch.isfinite(x.grad).all()
    used = result.inliers & result.success[:, None]
    assert (image.grad[used].abs().sum(-1) > 0).all()
    assert (image.grad[~valid] == 0).all()


def test_gradient_of_the_pose_with_respect_to_the_image() -> None:
    """Moving all image points of a distant object moves the pose: compare with finite differences."""
    rng = np.random.default_rng(13)
    image, model, K, _ = stack([spoil(make_scene(rng, 40, "volume"), rng, 0.0, 0.2)], torch.float64)
    ransac = RansacPnp()

    def translation(shift: torch.Tensor) -> torch.Tensor:
        return ransac(PnpProblem(image + shift, model, K)).T_camera_from_model[:, :3, 3]

    assert torch.autograd.gradcheck(
        translation,
        (torch.zeros(2, dtype=torch.float64, requires_grad=True),),
        eps=1e-4,
        atol=1e-3,
        rtol=1e-2,
    )


def test_ranks_are_distinct_and_uniform() -> None:
    draws = torch.randint(2**31, (20000, 4), generator=torch.Generator().manual_seed(0))
    ranks = distinct_ranks(draws, torch.tensor([4, 5, 300]))
    assert ranks.shape == (3, 20000, 4)
    for picks, count in zip(ranks, (4, 5, 300), strict=True):
        assert picks.min() == 0
        assert picks.max() == count - 1
        assert all(len(set(row)) == 4 for row in picks.tolist())
        for k in range(4):
            frequency = torch.bincount(picks[:, k], minlength=count) / 20000
            sigma = (1 / count * (1 - 1 / count) / 20000) ** 0.5
            assert (frequency - 1 / count).abs().max() < 5 * sigma
    top = torch.full((1, 4), 2**31 - 1)
    assert distinct_ranks(top, torch.tensor([7])).tolist() == [[[6, 5, 4, 3]]]


def test_autocast_does_not_lower_the_precision() -> None:
    inputs = stack(random_scenes(8, seed=14), torch.float32)
    plain = RansacPnp()(PnpProblem(*inputs))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = RansacPnp()(PnpProblem(*inputs))
    assert torch.equal(plain.T_camera_from_model, mixed.T_camera_from_model)


def test_state_and_empty_input() -> None:
    ransac = RansacPnp(iterations=10)
    assert ransac.state_dict() == {}
    assert ransac.draws.shape == (10, 4)
    none = ransac(PnpProblem(torch.zeros(2, 0, 2), torch.zeros(2, 0, 3), torch.eye(3).expand(2, 3, 3)))
    assert none.status.tolist() == [PnpStatus.TOO_FEW_CORRESPONDENCES] * 2
    assert torch.isfinite(none.T_camera_from_model).all()
    empty = ransac(PnpProblem(torch.zeros(0, 5, 2), torch.zeros(0, 5, 3), torch.zeros(0, 3, 3)))
    assert empty.T_camera_from_model.shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"iterations": 0}, "iterations and chunk must be at least 1, got 0 and None"),
        ({"threshold": 0.0}, r"threshold must be positive \(pixels\), got 0.0"),
        ({"min_inliers": 3}, "min_inliers must be at least 4, got 3"),
        ({"confidence": 1.0}, "confidence must lie between 0 and 1, got 1.0"),
        ({"polish_rounds": -1}, "polish_rounds must be at least 0, got -1"),
        ({"solver": "upnp"}, r"solver must be one of \['dlt', 'epnp', 'p3p'\], got 'upnp'"),
    ],
)
def test_bad_settings(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RansacPnp(**arguments)


def test_bad_shapes() -> None:
    with pytest.raises(ValueError, match=r"points_image must have shape \(B, N, 2\), got \(5, 2\)"):
        RansacPnp()(PnpProblem(torch.zeros(5, 2), torch.zeros(5, 3), torch.eye(3)))
    with pytest.raises(ValueError, match=r"valid must have shape \(1, 5\), got \(5,\)"):
        RansacPnp()(PnpProblem(torch.zeros(1, 5, 2), torch.zeros(1, 5, 3), torch.eye(3)[None], torch.ones(5)))


@pytest.mark.parametrize("solver", ["epnp", "p3p"])
def test_points_behind_the_camera_are_flagged(solver: str) -> None:
    """Pixels of points that lie behind the camera: some sets fit no pose in front of it."""
    K = torch.tensor([[800.0, 0.0, 200.0], [0.0, 800.0, 200.0], [0.0, 0.0, 1.0]])
    generator = torch.Generator().manual_seed(0)
    model = torch.randn(40, 4, 3, generator=generator) * 50
    camera = model + torch.tensor([10.0, 20.0, -120.0])
    pixels = (camera / camera[..., 2:] @ K.T)[..., :2]
    result = RansacPnp(solver, min_inliers=4)(PnpProblem(pixels, model, K.expand(40, 3, 3)))
    behind = result.status == PnpStatus.BEHIND_CAMERA
    if solver == "epnp":  # three points can be put in front of the camera nearly always
        assert behind.sum() >= 3
    assert (result.num_inliers[behind] == 0).all()
    assert not result.success[behind].any()
    assert torch.isfinite(result.T_camera_from_model).all()
    # Whatever is called a pose has its inliers in front of the camera and on their pixels.
    placed = model @ result.T_camera_from_model[:, :3, :3].mT + result.T_camera_from_model[:, None, :3, 3]
    assert (placed[..., 2][result.inliers] > 0).all()
    projected = (placed / placed[..., 2:] @ K.T)[..., :2]
    assert (torch.linalg.vector_norm(projected - pixels, dim=-1)[result.inliers] < 10.0).all()

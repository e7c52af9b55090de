import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from foundpose.pnp import LevenbergMarquardtPnp, MinimalSolution, PnpProblem, solve_epnp
from tests.pnp.scenes import make_scene, pose_errors, stack

SHAPES = ["volume", "ellipsoid", "plane"]


def polished(solution: MinimalSolution, problem: PnpProblem, iterations: int = 20) -> Tensor:
    return LevenbergMarquardtPnp(max_iterations=iterations)(
        solution.T_camera_from_model, problem
    ).T_camera_from_model


def scenes_of(count: int, points: int, shape: str, wide: bool, seed: int = 0):
    rng = np.random.default_rng(seed)
    return [make_scene(rng, points, shape, wide) for _ in range(count)]


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [6, 20])
def test_recovers_known_poses(points: int, shape: str, wide: bool) -> None:
    scenes = scenes_of(200, points, shape, wide)
    image, model, K, _ = stack(scenes, torch.float64)
    solution = solve_epnp(PnpProblem(image, model, K))
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
    solution = solve_epnp(PnpProblem(image, model, K))
    T = polished(solution, PnpProblem(image, model, K))
    angle, distance = pose_errors(T, scenes)
    assert ((np.radians(angle) < 1e-6) & (distance < 1e-6)).mean() >= 0.95


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("points", [4, 6, 30])
def test_float32(points: int, shape: str) -> None:
    scenes = scenes_of(200, points, shape, False)
    image, model, K, _ = stack(scenes, torch.float32)
    solution = solve_epnp(PnpProblem(image, model, K))
    assert solution.T_camera_from_model.dtype == torch.float32
    angle, distance = pose_errors(solution.T_camera_from_model, scenes)
    assert ((angle < 0.5) & (distance < 2e-3)).mean() >= 0.9
    T = polished(solution, PnpProblem(image, model, K))
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
    ours, _ = pose_errors(solve_epnp(PnpProblem(image, model, K)).T_camera_from_model, scenes)
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
    subset = solve_epnp(PnpProblem(image[:, :7], model[:, :7], K))
    image[:, 7:] += 50.0
    image[0, 8], model[1, 9] = torch.nan, torch.inf
    weights = torch.zeros(50, 12, dtype=torch.float64)
    weights[:, :7] = 3.0
    for w in (weights, weights > 0):
        masked = solve_epnp(PnpProblem(image, model, K, weights=w))
        assert masked.valid.all()
        torch.testing.assert_close(
            masked.T_camera_from_model, subset.T_camera_from_model, rtol=1e-7, atol=1e-6
        )
    # Four weighted points among padding are solved as well.
    weights[:, 4:] = 0.0
    four = solve_epnp(PnpProblem(image, model, K, weights=weights))
    known = image.nan_to_num(), model.nan_to_num(posinf=0.0), K
    T = polished(four, PnpProblem(*known, weights=weights))
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
    plain, _ = pose_errors(solve_epnp(PnpProblem(image, model, K)).T_camera_from_model, scenes)
    weighted, _ = pose_errors(
        solve_epnp(PnpProblem(image, model, K, weights=weights)).T_camera_from_model, scenes
    )
    assert np.median(weighted) < 0.2 * np.median(plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("points", [4, 5, 9])
def test_degenerate_samples_are_flagged_among_good_ones(points: int, dtype: torch.dtype) -> None:
    image, model, K, _ = stack(scenes_of(7, points, "volume", False), dtype)
    clean = solve_epnp(PnpProblem(image, model, K))
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
    solution = solve_epnp(PnpProblem(image, model, K, weights=weights))
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
    solution = solve_epnp(PnpProblem(image, model, K))
    camera = model @ solution.T_camera_from_model[:, :3, :3].mT + solution.T_camera_from_model[:, None, :3, 3]
    assert (camera[solution.valid][..., 2] > 0).all()


def test_batch_independence() -> None:
    scenes = scenes_of(8, 9, "volume", False)
    image, model, K, _ = stack(scenes, torch.float64)
    for n in (4, 9):
        together = solve_epnp(PnpProblem(image[:, :n], model[:, :n], K)).T_camera_from_model
        alone = torch.cat(
            [
                solve_epnp(
                    PnpProblem(image[i : i + 1, :n], model[i : i + 1, :n], K[i : i + 1])
                ).T_camera_from_model
                for i in range(8)
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
    solution = solve_epnp(PnpProblem(image, model, K))
    T = solution.T_camera_from_model
    angle, _ = pose_errors(T, scenes)
    assert angle.max() < 1e-5
    T = polished(solution, PnpProblem(image, model, K), 10)
    assert pose_errors(T, scenes)[0].max() < 1e-9


def test_gradients_are_finite() -> None:
    image, model, K, _ = stack(scenes_of(10, 8, "volume", False), torch.float64)
    for n in (4, 8):
        inputs = [x.clone().requires_grad_() for x in (image[:, :n], model[:, :n], K)]
        solve_epnp(PnpProblem(*inputs)).T_camera_from_model.square().sum().backward()
        for x in inputs:
            assert torch.isfinite(x.grad).all()
            assert x.grad.abs().max() > 0


def test_bad_input() -> None:
    image, model, K, _ = stack(scenes_of(2, 6, "volume", False), torch.float32)
    with pytest.raises(ValueError, match="at least 4 correspondences, got N = 3"):
        solve_epnp(PnpProblem(image[:, :3], model[:, :3], K))
    with pytest.raises(ValueError, match=r"points_model must have shape \(2, 6, 3\), got \(2, 5, 3\)"):
        solve_epnp(PnpProblem(image, model[:, :5], K))
    with pytest.raises(ValueError, match=r"K must have shape \(2, 3, 3\).*got \(3, 3\)"):
        solve_epnp(PnpProblem(image, model, K[0]))
    with pytest.raises(ValueError, match=r"weights must have shape \(2, 6\)"):
        solve_epnp(PnpProblem(image, model, K, weights=torch.ones(2, 5)))
    with pytest.raises(ValueError, match="float16"):
        solve_epnp(PnpProblem(image.half(), model.half(), K.half()))


def noisy_problem(points: int, shape: str, seed: int, sigma: float = 0.1) -> list[Tensor]:
    """Image and model points in hundreds of pixels and millimetres, intrinsics and weights; all of order one."""
    image, model, K, _ = stack(scenes_of(1, points, shape, True, seed=seed), torch.float64)
    g = torch.Generator().manual_seed(seed)
    image = image + sigma * torch.randn(image.shape, generator=g, dtype=torch.float64)
    weights = 0.5 + torch.rand(1, points, generator=g, dtype=torch.float64)
    units = torch.diag(torch.tensor([0.01, 0.01, 1.0], dtype=torch.float64))
    return [image / 100.0, model / 100.0, units @ K, weights]


def intrinsics(parameters: Tensor) -> Tensor:
    """(B, 5) focal lengths, skew and principal point → (B, 3, 3)."""
    zero, one = torch.zeros_like(parameters[:, 0]), torch.ones_like(parameters[:, 0])
    fx, fy, skew, cx, cy = parameters.unbind(-1)
    return torch.stack([fx, skew, cx, zero, fy, cy, zero, zero, one], dim=-1).unflatten(-1, (3, 3))


@pytest.mark.parametrize(
    ("points", "shape"),
    [(4, "volume"), (4, "plane"), (5, "plane"), (8, "volume"), (8, "plane"), (20, "volume")],
)
def test_gradients_agree_with_finite_differences(points: int, shape: str) -> None:
    image, model, K, weights = noisy_problem(points, shape, seed=2)
    parameters = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 1], K[:, 0, 2], K[:, 1, 2]], dim=-1)
    # Out of its plane an exactly flat object has other solutions at once: only motion inside is smooth.
    moving = 3 if shape == "volume" or points == 4 else 2

    def pose(image: Tensor, moved: Tensor, parameters: Tensor, weights: Tensor | None = None) -> Tensor:
        points_model = torch.cat([moved, model[..., moving:]], dim=-1)
        return solve_epnp(
            PnpProblem(image, points_model, intrinsics(parameters), weights=weights)
        ).T_camera_from_model[:, :3]

    # The refinement stops after five steps, so the gradient of the optimum differs a little from that of the steps.
    def check(inputs: list[Tensor]) -> bool:
        inputs = [x.clone().requires_grad_() for x in inputs]
        # Every entry of small problems, random projections (fast mode) of larger ones.
        return torch.autograd.gradcheck(pose, inputs, eps=1e-6, atol=1e-4, rtol=1e-3, fast_mode=points >= 8)

    inputs = [image, model[..., :moving], parameters]
    assert check(inputs if points == 4 else [*inputs, weights])


@pytest.mark.parametrize("points", [4, 6, 12])
@pytest.mark.parametrize("shape", SHAPES)
def test_most_gradients_agree_with_finite_differences_under_noise(points: int, shape: str) -> None:
    scenes = scenes_of(200, points, shape, False, seed=7)
    image, model, K, _ = stack(scenes, torch.float64)
    g = torch.Generator().manual_seed(0)
    image = image + 0.5 * torch.randn(image.shape, generator=g, dtype=torch.float64)
    direction = torch.randn(image.shape, generator=g, dtype=torch.float64)
    cotangent = torch.randn(200, 3, 3, generator=g, dtype=torch.float64)

    def values(image: Tensor) -> Tensor:
        return (solve_epnp(PnpProblem(image, model, K)).T_camera_from_model[:, :3, :3] * cotangent).sum(
            (1, 2)
        )

    image.requires_grad_()
    (grad,) = torch.autograd.grad(values(image).sum(), image)
    analytic = (grad * direction).sum((1, 2))
    step = 1e-5 * direction
    numeric = (values(image.detach() + step) - values(image.detach() - step)) / 2e-5
    close = (analytic - numeric).abs() <= 1e-3 * (numeric.abs() + numeric.abs().median())
    assert close.double().mean() >= 0.85


HARD_CASES = {
    # Name: whether it is degenerate.
    "identity": False,
    "half turn": False,
    "coplanar": False,
    "square": False,
    "cross": False,
    "zero weight": False,
    "negative weight": False,
    "noise": False,
    "collinear": True,
    "coincident": True,
    "at origin": True,
    "same pixel": True,
    "too few": True,
    "NaN image": True,
    "infinite model": True,
    "NaN weight": True,
    "NaN K": True,
    "singular K": True,
    "zero K": True,
}


def hard_case(name: str, points: int, dtype: torch.dtype) -> tuple[list[Tensor], bool]:
    """One problem as image points, model points, intrinsics and weights, and whether it is degenerate."""
    g = torch.Generator().manual_seed(points)
    model = torch.rand(1, points, 3, generator=g, dtype=torch.float64) * 100.0 - 50.0
    R = torch.eye(3, dtype=torch.float64)
    angle = torch.arange(points, dtype=torch.float64) * 2.0 * torch.pi / points
    circle = torch.stack([50.0 * angle.cos(), 50.0 * angle.sin(), 0.0 * angle], dim=-1)
    if name == "half turn":
        R = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    elif name == "coplanar":
        model[..., 2] = 0.0
    elif name == "square":
        model = circle[None]
    elif name == "cross":  # tetrahedron or antiprism: repeated principal axes
        model = circle[None].clone()
        model[:, ::2, 2], model[:, 1::2, 2] = 20.0, -20.0
    elif name == "collinear":
        model = model[:, :1] * torch.linspace(-1.0, 1.0, points, dtype=torch.float64)[None, :, None]
    elif name in ("coincident", "at origin"):
        model = (model[:, :1] * (name == "coincident")).repeat(1, points, 1)
    K = torch.tensor([[[600.0, 0.0, 210.0], [0.0, 600.0, 210.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    camera = model @ R.T + torch.tensor([3.0, -5.0, 400.0], dtype=torch.float64)
    image = (camera @ K.mT)[..., :2] / camera[..., 2:]
    weights = torch.ones(1, points, dtype=torch.float64)
    degenerate = HARD_CASES[name]
    few = 5 if points > 5 else 0  # where one point less still leaves four of a non-degenerate problem
    if name in ("zero weight", "negative weight"):
        weights[0, -1] = -1.0 if name == "negative weight" else 0.0
        degenerate = points == 4
    elif name == "noise":
        image = image + torch.randn(image.shape, generator=g, dtype=torch.float64)
    elif name == "same pixel":
        image = image[:, :1].repeat(1, points, 1)
    elif name == "too few":
        weights[:, 3:] = 0.0
    elif name in ("NaN image", "infinite model", "NaN weight"):
        gone = slice(0, None if not few else 1)
        if name == "NaN image":
            image[0, gone] = torch.nan
        elif name == "infinite model":
            model[0, gone, 1] = torch.inf
        else:
            weights[0, gone] = torch.nan
        degenerate = not few
    elif name == "NaN K":
        K[:] = torch.nan
    elif name == "singular K":
        K[:, 0, 0] = 0.0
    elif name == "zero K":
        K[:] = 0.0
    return [x.to(dtype) for x in (image, model, K, weights)], degenerate


def gradients(inputs: list[Tensor]) -> tuple[MinimalSolution, list[Tensor]]:
    inputs = [x.clone().requires_grad_() for x in inputs]
    solution = solve_epnp(PnpProblem(*inputs[:3], weights=inputs[3]))
    T = solution.T_camera_from_model
    factors = torch.linspace(0.5, 2.0, 16, dtype=T.dtype).view(4, 4)
    grads = torch.autograd.grad((T * factors).sum(), inputs, allow_unused=True)
    return solution, [torch.zeros_like(x) if g is None else g for x, g in zip(inputs, grads, strict=True)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("points", [4, 5, 6, 12])
@pytest.mark.parametrize("name", HARD_CASES)
def test_gradients_of_hard_cases(name: str, points: int, dtype: torch.dtype) -> None:
    inputs, degenerate = hard_case(name, points, dtype)
    solution, grads = gradients(inputs)
    assert solution.degenerate.item() == degenerate
    assert solution.valid.item() == (not degenerate)
    assert torch.isfinite(solution.T_camera_from_model).all()
    for x, grad in zip(inputs, grads, strict=True):
        assert torch.isfinite(grad).all()
        if degenerate:
            assert (grad == 0).all()
        # No smooth branch of a well-posed problem is as steep.
        assert (grad.abs() * x.abs().nan_to_num(0.0, 0.0, 0.0)).max() < 1e9
    if not degenerate:
        assert all(grad.abs().max() > 0 for grad in grads[:3])
    ignored = ~(inputs[3] > 0) | ~torch.isfinite(inputs[0]).all(-1) | ~torch.isfinite(inputs[1]).all(-1)
    assert all((grads[i][ignored] == 0).all() for i in (0, 1, 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("points", [4, 6])
def test_gradients_do_not_depend_on_neighbours(points: int, dtype: torch.dtype) -> None:
    """Not even on degenerate ones."""
    cases = [hard_case(name, points, dtype)[0] for name in HARD_CASES]
    together = gradients([torch.cat(parts) for parts in zip(*cases, strict=True)])[1]
    for i, (name, case) in enumerate(zip(HARD_CASES, cases, strict=True)):
        # Symmetric objects have no axes of their own: rounding decides.
        if name in ("identity", "half turn", "noise", "zero weight") or HARD_CASES[name]:
            for whole, alone in zip(together, gradients(case)[1], strict=True):
                scale = alone.abs().max().item()
                torch.testing.assert_close(
                    whole[i : i + 1], alone, rtol=0.0, atol=1e4 * torch.finfo(dtype).eps * scale
                )


@pytest.mark.parametrize("points", [4, 5, 9])
def test_gradients_do_not_change_values(points: int) -> None:
    image, model, K, _ = stack(scenes_of(100, points, "volume", False), torch.float32)
    plain = solve_epnp(PnpProblem(image, model, K)).T_camera_from_model
    assert not plain.requires_grad
    assert torch.equal(solve_epnp(PnpProblem(image.requires_grad_(), model, K)).T_camera_from_model, plain)

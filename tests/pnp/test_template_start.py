import math

import pytest
import torch

from foundpose.geometry import (
    intrinsics_matrix,
    invert_transform,
    make_transform,
    project_points,
    rotation_angle,
    transform_points,
)
from foundpose.geometry.transforms import se3_exp
from foundpose.pnp import PnpProblem, RansacPnp, TemplateStart

K_TEMPLATE = intrinsics_matrix(1000.0, 1000.0, 209.5, 209.5).double()
K_CROP = intrinsics_matrix(1400.0, 1400.0, 209.5, 209.5).double()


def scene(angle: float = 0.3, depth: float = 9.0, lateral: float = 0.2, wrong: float = 0.0):
    """Points seen by a template and by a crop whose cameras differ in plane, scale and shift."""
    g = torch.Generator().manual_seed(7)
    points = torch.rand(120, 3, generator=g, dtype=torch.float64) - 0.5
    R = se3_exp(torch.tensor([0, 0, 0, 0.4, -0.7, 0.2]).double())[:3, :3]
    T_template = make_transform(R, torch.tensor([0.05, -0.1, 6.0]).double())
    c, s = math.cos(angle), math.sin(angle)
    in_plane = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).double()
    T_crop = make_transform(in_plane @ R, torch.tensor([lateral, 0.1, depth]).double())
    u_template = project_points(transform_points(T_template, points), K_TEMPLATE)[0]
    u_crop = project_points(transform_points(T_crop, points), K_CROP)[0]
    matched = points.clone()
    mixed = torch.rand(120, generator=g) < wrong
    shuffle = torch.randperm(120, generator=g)
    u_template = torch.where(mixed[:, None], u_template[shuffle], u_template)
    matched = torch.where(mixed[:, None], points[shuffle], points)
    return points, T_template, T_crop, u_template, u_crop, matched


def start_of(T_template, u_template, u_crop, centre):
    return TemplateStart()(
        u_crop[None],
        u_template[None, None],
        torch.ones(1, 1, len(u_crop)).double(),
        K_CROP[None],
        T_template[None, None],
        K_TEMPLATE[None, None],
        centre,
    )[0, 0]


@pytest.mark.parametrize("wrong", [0.0, 0.3])
@pytest.mark.parametrize("angle", [0.0, 0.3, -0.5])
def test_finds_the_pose_from_the_motion_in_the_plane(angle, wrong):
    points, T_template, T_crop, u_template, u_crop, _ = scene(angle, wrong=wrong)
    T = start_of(T_template, u_template, u_crop, points.mean(0))
    # Weak perspective: the object is a sixth to a ninth of its distance wide.
    assert math.degrees(float(rotation_angle(T[:3, :3], T_crop[:3, :3]))) < 3.0
    assert abs(float(T[2, 3] / T_crop[2, 3]) - 1.0) < 0.03
    torch.testing.assert_close(T[:2, 3], T_crop[:2, 3], atol=0.03, rtol=0)


def test_the_same_camera_gives_the_same_pose():
    points, T_template, *_ = scene()
    u = project_points(transform_points(T_template, points), K_TEMPLATE)[0]
    T = TemplateStart()(
        u[None],
        u[None, None],
        torch.ones(1, 1, 120).double(),
        K_TEMPLATE[None],
        T_template[None, None],
        K_TEMPLATE[None, None],
        points.mean(0),
    )
    torch.testing.assert_close(T[0, 0], T_template, atol=1e-9, rtol=0)


def test_polish_brings_the_start_to_the_truth():
    points, T_template, T_crop, u_template, u_crop, matched = scene(wrong=0.4)
    T = start_of(T_template, u_template, u_crop, points.mean(0))
    problem = PnpProblem(u_crop[None], matched[None], K_CROP[None])
    result = RansacPnp().polish_starts(T[None], problem)
    assert result.success.all()
    # A wrong match may lie within the threshold by chance; samples lead to the same pose.
    assert float(rotation_angle(result.T_camera_from_model[0, :3, :3], T_crop[:3, :3])) < 0.01
    sampled = RansacPnp()(problem).T_camera_from_model
    torch.testing.assert_close(result.T_camera_from_model, sampled, atol=1e-3, rtol=1e-3)
    # A start that is no pose, and one that is far off, are flagged or finite; never an exception.
    nan = RansacPnp().polish_starts(torch.full((1, 4, 4), torch.nan).double(), problem)
    assert not nan.success.any()
    assert nan.T_camera_from_model.isfinite().all()
    far = RansacPnp().polish_starts(invert_transform(T_crop)[None], problem)
    assert far.T_camera_from_model.isfinite().all()


def test_gradient_and_batch_independence():
    points, T_template, _, u_template, u_crop, _ = scene(wrong=0.2)
    u = u_crop[None, :20].clone().requires_grad_()
    v = u_template[None, None, :20].clone().requires_grad_()
    weight = torch.ones(1, 1, 20).double()

    def pose(a, b):
        return TemplateStart()(
            a, b, weight, K_CROP[None], T_template[None, None], K_TEMPLATE[None, None], points.mean(0)
        )

    assert torch.autograd.gradcheck(pose, [u, v])
    both = TemplateStart()(
        torch.cat([u, u + 3.0]).detach(),
        torch.cat([v, v - 5.0]).detach(),
        weight.expand(2, 1, 20),
        K_CROP.expand(2, 3, 3),
        T_template.expand(2, 1, 4, 4),
        K_TEMPLATE.expand(2, 1, 3, 3),
        points.mean(0),
    )
    torch.testing.assert_close(both[:1], pose(u, v).detach(), atol=1e-12, rtol=0)


def test_guided_samples_find_what_uniform_ones_miss():
    g = torch.Generator().manual_seed(3)
    problems, right = 24, 0.12
    points, _, T_crop, _, u_crop, _ = scene()
    shuffles = torch.stack([torch.randperm(120, generator=g) for _ in range(problems)])
    good = torch.rand(problems, 120, generator=g) < right
    matched = torch.where(good[..., None], points, points[shuffles])
    # Priorities tell right matches from wrong ones, but badly.
    priority = good.double() + 1.5 * torch.randn(problems, 120, generator=g, dtype=torch.float64)
    problem = PnpProblem(u_crop.expand(problems, -1, -1), matched, K_CROP.expand(problems, 3, 3))

    def share(pnp, priority):
        T = pnp(problem, priority=priority).T_camera_from_model
        return float(
            (rotation_angle(T[:, :3, :3], T_crop[:3, :3].expand(problems, 3, 3)) < 0.02).float().mean()
        )

    uniform = share(RansacPnp(iterations=100), None)
    assert share(RansacPnp(iterations=100, guidance=3.0), priority) > uniform + 0.1
    # Without a preference the order does not matter to what is drawn, only to whom.
    assert abs(share(RansacPnp(iterations=100, guidance=1.0), priority) - uniform) < 0.25
    # Only the order of priorities counts.
    guided = RansacPnp(iterations=100, guidance=2.0)
    first = guided(problem, priority=priority).T_camera_from_model
    assert torch.equal(first, guided(problem, priority=priority.exp()).T_camera_from_model)
    with pytest.raises(ValueError, match="guidance must be at least 1"):
        RansacPnp(guidance=0.5)
    with pytest.raises(ValueError, match="priority must have shape"):
        RansacPnp()(problem, priority=priority[:, :5])

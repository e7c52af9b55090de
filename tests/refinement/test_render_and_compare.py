import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn

from foundpose.geometry import (
    Crops,
    PatchGrid,
    PerspectiveCrop,
    intrinsics_matrix,
    make_transform,
    pixel_rays,
    project_points,
    transform_points,
)
from foundpose.refinement import (
    Observation,
    PicturedObjects,
    PoseProposals,
    RenderAndCompareRefiner,
    UpdateNetwork,
)
from foundpose.rendering import RaycastRenderer
from foundpose.representation import ObjectGroups
from foundpose.synthetic import procedural_mesh
from foundpose.training import Perturbation
from tests.refinement.learned import Constant, Oracle, small_network, stirred_network

K = intrinsics_matrix(500.0, 505.0, 161.0, 118.0)
HEIGHT, WIDTH = 240, 320


class Setting(NamedTuple):
    mesh: object
    images: Tensor
    T_true: Tensor
    T_start: Tensor


@pytest.fixture(scope="module")
def setting():
    """Four pictures of an object whose origin is far from its centre, and poses beside the true ones."""
    mesh = procedural_mesh(5, subdivisions=4)
    mesh = type(mesh)(mesh.vertices + torch.tensor([300.0, -200.0, 100.0]), mesh.faces, mesh.vertex_colors)
    centre = mesh.bounds.mean(0)
    generator = torch.Generator().manual_seed(0)
    R = torch.linalg.qr(torch.randn(4, 3, 3, generator=generator))[0]
    R = R * torch.linalg.det(R)[:, None, None]
    pixels = torch.tensor([[160.0, 120.0], [90.0, 80.0], [240.0, 160.0], [200.0, 60.0]])
    t = pixel_rays(pixels, K) * torch.tensor([400.0, 500.0, 450.0, 600.0])[:, None] - R @ centre
    T_true = make_transform(R, t)
    render = RaycastRenderer()(mesh, T_true, K[None], (HEIGHT, WIDTH))
    noise = torch.rand(4, 3, HEIGHT, WIDTH, generator=generator)
    images = torch.where(render.mask[:, None], render.rgb, noise)
    T_start = Perturbation()(T_true, centre.expand(4, 3), range(4))
    return Setting(mesh, images, T_true, T_start)


def pictured(setting, rows=slice(None), meshes=None, mesh_index=None):
    images = setting.images[rows]
    index = torch.arange(len(images))
    return PicturedObjects(
        images,
        K.to(images).expand(len(images), 3, 3),
        index,
        meshes or [setting.mesh],
        0 * index if mesh_index is None else mesh_index,
    )


def refine(refiner, setting, T, rows=slice(None)):
    return refiner.refine(T[rows], pictured(setting, rows))


def propose(setting, T, valid=None, meshes="own"):
    """Proposals (4, n) in crop frames that are turned against the camera's, and what they belong to."""
    n = T.shape[1]
    crops = PerspectiveCrop(96)(
        setting.images, K.expand(4, 3, 3), boxes=torch.tensor([[60.0, 40, 200, 180]]).expand(4, 4)
    )
    proposals = PoseProposals(
        T_crop_from_model=crops.T_crop_from_camera[:, None] @ T,
        score=torch.full((4, n), 0.25),
        valid=torch.ones(4, n, dtype=torch.bool) if valid is None else valid,
        template_index=torch.zeros(4, n, dtype=torch.int64),
    )
    return proposals, Observation(
        crops=crops,
        features=None,
        grid=PatchGrid(14.0, 6.5, 30),
        query=None,
        groups=ObjectGroups([None], None, 4, torch.device("cpu")),
        images=setting.images,
        K=K.expand(4, 3, 3),
        image_index=torch.arange(4),
        meshes=[setting.mesh] if meshes == "own" else meshes,
    )


def to_camera(crops: Crops, T):
    return torch.linalg.inv(crops.T_crop_from_camera)[:, None] @ T


def distance(setting, T_a, T_b):
    points = setting.mesh.vertices[::10]
    return (transform_points(T_a, points) - transform_points(T_b, points)).norm(dim=-1).mean(-1) / float(
        setting.mesh.diameter
    )


def test_untrained_network_moves_nothing(setting):
    refiner = RenderAndCompareRefiner(UpdateNetwork(), RaycastRenderer(1))
    with torch.no_grad():
        found = refine(refiner, setting, setting.T_start)
    assert found.valid.all()
    assert found.logit is None
    torch.testing.assert_close(found.T_camera_from_model, setting.T_start, rtol=1e-5, atol=5e-3)
    count = sum(p.numel() for p in refiner.network.parameters())
    assert 3e5 < count < 1e6


def test_oracle_reaches_the_truth(setting):
    refiner = Oracle(nn.Identity(), RaycastRenderer(1), iterations=1, size=32).aim(setting.T_true)
    found = refine(refiner, setting, setting.T_start)
    assert found.valid.all()
    assert distance(setting, found.T_camera_from_model, setting.T_true).max() < 1e-4
    # Half of the way each time: the error falls to a small share in five iterations.
    refiner = Oracle(nn.Identity(), RaycastRenderer(1), iterations=5, size=32).aim(setting.T_true, 0.5)
    found = refine(refiner, setting, setting.T_start)
    before = distance(setting, setting.T_start, setting.T_true)
    assert (distance(setting, found.T_camera_from_model, setting.T_true) < 0.1 * before).all()


def test_views_are_centred_on_the_object_at_the_current_pose(setting):
    refiner = RenderAndCompareRefiner(nn.Identity(), RaycastRenderer(1), size=64, margin=1.4)
    for T in (setting.T_start, setting.T_true):
        views = refiner.look(T, pictured(setting))
        middle, _ = project_points(transform_points(views.T_view_from_model, views.centre[:, None]), views.K)
        torch.testing.assert_close(middle[:, 0], torch.full((4, 2), 31.5), rtol=0, atol=2e-2)
        # The whole object is in it, its farther reach at 1 / margin of the half side.
        pixels, _ = project_points(transform_points(views.T_view_from_model, setting.mesh.vertices), views.K)
        reach = (pixels - 31.5).abs().amax((1, 2))
        torch.testing.assert_close(reach, torch.full((4,), 32.0 / 1.4), rtol=0.06, atol=0.0)
        torch.testing.assert_close(views.T_view_from_camera @ T, views.T_view_from_model)
    # At the true pose crop and rendering show the same object.
    shown = views.renderings.sum(1) > 0
    inside = -torch.nn.functional.max_pool2d(-shown[:, None].float(), 5, stride=1, padding=2)[:, 0] > 0
    gap = (views.crops - views.renderings).abs().mean(1)
    assert gap[inside].mean() < 0.04
    assert gap[~shown].mean() > 0.3


def test_crop_is_cut_anew_in_every_iteration(setting):
    """A network that always says "ten pixels to the right" sees what is farther right each time."""
    network = Constant(10.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    refiner = RenderAndCompareRefiner(network, RaycastRenderer(1), iterations=3, size=64)
    with torch.no_grad():
        found = refine(refiner, setting, setting.T_true)
    first, second, third = (pictures[0] for pictures in network.seen)
    shift = [(b[:3, :, :-10] - a[:3, :, 10:]).abs().mean() for a, b in ((first, second), (second, third))]
    assert max(shift) < 0.12
    assert (first[:3] - second[:3]).abs().mean() > 2 * max(shift)
    # The rendering stays where it is: the camera goes with the object.
    assert (first[3:] - third[3:]).abs().mean() < 0.05
    centre = setting.mesh.bounds.mean(0)[None]
    pixel = [
        project_points(transform_points(T[0], centre), K)[0][0, 0]
        for T in (setting.T_true, found.T_camera_from_model)
    ]
    assert pixel[1] - pixel[0] > 15.0


def test_alone_as_in_a_batch(setting):
    refiner = RenderAndCompareRefiner(stirred_network(), RaycastRenderer(1), iterations=2, size=64)
    with torch.no_grad():
        together = refine(refiner, setting, setting.T_start).T_camera_from_model
        assert (distance(setting, together, setting.T_start) > 1e-3).all()
        for b in range(4):
            alone = refine(refiner, setting, setting.T_start, slice(b, b + 1)).T_camera_from_model
            torch.testing.assert_close(alone[0], together[b], rtol=1e-3, atol=0.05)


def test_poses_that_cannot_be_rendered_come_back_as_they_came(setting):
    T = setting.T_start[:, None].repeat(1, 6, 1, 1)
    T[:, 1, 2, 3] = -T[:, 1, 2, 3].abs()  # behind
    T[:, 2, 0, 3] += 5000.0  # outside the picture
    T[:, 3, 0, 0] = torch.nan
    T[:, 4] = make_transform(torch.eye(3), -setting.mesh.bounds.mean(0))  # around the camera
    valid = torch.ones(4, 6, dtype=torch.bool)
    valid[:, 5] = False
    proposals, observation = propose(setting, T, valid)
    refiner = RenderAndCompareRefiner(stirred_network(), RaycastRenderer(1), iterations=2, size=64)
    with torch.no_grad():
        refined = refiner(proposals, observation)
        assert refined.valid.tolist() == [[True] + 5 * [False]] * 4
        torch.testing.assert_close(
            refined.T_crop_from_model[:, 1:],
            proposals.T_crop_from_model[:, 1:],
            equal_nan=True,
            rtol=0,
            atol=0,
        )
        assert torch.equal(refined.score, proposals.score)
        moved = to_camera(observation.crops, refined.T_crop_from_model)[:, 0]
        # The good one is refined as if the others were not there.
        alone = refiner(*propose(setting, T[:, :1]))
        torch.testing.assert_close(alone.T_crop_from_model[:, 0], refined.T_crop_from_model[:, 0])
        assert torch.isfinite(moved).all()
        # Networks that move a pose where it cannot be, or that say nothing.
        for values in (
            (0.0, 0.0, -1.0, 1.0, 0, 0, 0, 1, 0),
            (1e5, 0.0, 1.0, 1.0, 0, 0, 0, 1, 0),
            (0.0, 0.0, 1.0, 1.0, 0, 0, 2, 0, 0),
            (math.nan, 0.0, 1.0, 1.0, 0, 0, 0, 1, 0),
        ):
            bad = RenderAndCompareRefiner(Constant(*values), RaycastRenderer(1), iterations=2, size=32)
            refined = bad(*propose(setting, T[:, :1]))
            assert not refined.valid.any(), values
            assert torch.equal(refined.T_crop_from_model, propose(setting, T[:, :1])[0].T_crop_from_model)
        nothing = refiner(*propose(setting, T, torch.zeros(4, 6, dtype=torch.bool)))
        assert not nothing.valid.any()


def test_score_of_the_network(setting):
    T = setting.T_start[:, None].repeat(1, 2, 1, 1)
    T[0, 1] = torch.nan
    network = Constant(0, 0, 1.0, 1, 0, 0, 0, 1, 0, 2.0)
    refined = RenderAndCompareRefiner(network, RaycastRenderer(1), iterations=1, size=32)(
        *propose(setting, T)
    )
    expected = torch.full((4, 2), 1 / (1 + math.exp(-2.0)))
    expected[0, 1] = 0.0
    torch.testing.assert_close(refined.score.detach(), expected)
    own = RenderAndCompareRefiner(small_network(), RaycastRenderer(1), iterations=1, size=32)
    assert torch.equal(own(*propose(setting, T)).score, torch.full((4, 2), 0.25))


def test_gradients_to_parameters_and_picture(setting):
    refiner = RenderAndCompareRefiner(stirred_network(), RaycastRenderer(1), iterations=2, size=64)
    images = setting.images.clone().requires_grad_()
    proposals, observation = propose(setting, setting.T_start[:, None])
    refined = refiner(proposals, observation._replace(images=images))
    (refined.T_crop_from_model[..., :3, :] * torch.tensor([1.0, 1, 1, 0.01])).square().sum().backward()
    for name, p in refiner.network.named_parameters():
        assert torch.isfinite(p.grad).all(), name
        assert p.grad.abs().max() > 0, name
    assert torch.isfinite(images.grad).all()
    assert (images.grad.flatten(1).abs().amax(1) > 0).all()


def test_gradient_of_one_iteration_against_finite_differences(setting):
    network = Constant(3.0, -2.0, 1.1, 0.9, 0.1, -0.1, 0.2, 1.1, 0.3).double()
    refiner = RenderAndCompareRefiner(network, RaycastRenderer(1), iterations=1, size=32)
    double = setting._replace(images=setting.images.double())

    def value():
        found = refiner.refine(setting.T_start.double(), pictured(double))
        return (found.T_camera_from_model[:, :3] * torch.linspace(-1, 1, 12).double().reshape(3, 4)).sum()

    value().backward()
    for k in range(9):
        values = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                network.values[k] += step
                values.append(value())
                network.values[k] -= step
        assert float(network.values.grad[k]) == pytest.approx(
            float(values[0] - values[1]) / 2e-6, rel=1e-4, abs=1e-4
        )


def test_several_objects_in_one_batch(setting):
    other = procedural_mesh(6, subdivisions=3)
    T = setting.T_start.clone()
    T[1] = make_transform(torch.eye(3), torch.tensor([0.0, 0.0, 500.0]))
    refiner = RenderAndCompareRefiner(nn.Identity(), RaycastRenderer(1), size=32)
    both = pictured(setting, meshes=[setting.mesh, other], mesh_index=torch.tensor([0, 1, 0, 0]))
    mixed, first = refiner.look(T, both), refiner.look(T, pictured(setting))
    second = refiner.look(T, pictured(setting, meshes=[other]))
    for field in ("crops", "renderings", "K", "centre"):
        expected = getattr(first, field).clone()
        expected[1] = getattr(second, field)[1]
        torch.testing.assert_close(getattr(mixed, field), expected)


def test_bad_arguments(setting):
    renderer = RaycastRenderer(1)
    for arguments, message in [
        ({"iterations": 0}, "got 0, 64 and 1.4"),
        ({"size": 1}, "got 5, 1 and 1.4"),
        ({"margin": 0.9}, "got 5, 64 and 0.9"),
    ]:
        with pytest.raises(ValueError, match=message):
            RenderAndCompareRefiner(small_network(), renderer, **arguments)
    refiner = RenderAndCompareRefiner(Constant(1.0, 2.0), renderer, size=32)
    T = setting.T_start[:, None]
    with pytest.raises(ValueError, match=r"\(M, 9\) or \(M, 10\) for M = 4 pictures, got \(4, 2\)"):
        refiner(*propose(setting, T))
    with pytest.raises(ValueError, match=r"pass their meshes to FoundPose\.forward"):
        refiner(*propose(setting, T, meshes=None))
    with pytest.raises(ValueError, match="got 2 meshes for 1 objects"):
        refiner(*propose(setting, T, meshes=[setting.mesh] * 2))

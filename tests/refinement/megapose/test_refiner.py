import pytest
import torch
from torch import nn

from foundpose.geometry import intrinsics_matrix, make_transform, transform_points
from foundpose.refinement import (
    MegaPoseNetwork,
    MegaPoseRefiner,
    MegaPoseScorer,
    PicturedObjects,
    update_between,
)
from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.rendering.raycast import RayScene
from foundpose.synthetic import procedural_mesh
from foundpose.training import Perturbation

K = intrinsics_matrix(500.0, 505.0, 161.0, 118.0)
SIZE = (240, 320)
SMALL = (48, 64)


def poses(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))[0]
    R = R * torch.linalg.det(R)[:, None, None]
    t = torch.tensor([[10.0, -15.0, 420.0], [-60.0, 30.0, 500.0], [70.0, 40.0, 450.0]])
    return make_transform(R, t.repeat(count, 1)[:count])


@pytest.fixture(scope="module")
def scene():
    """Pictures of two objects in known poses, and poses beside them."""
    meshes = [procedural_mesh(seed, subdivisions=3) for seed in (5, 6)]
    T = poses(6)
    which = torch.tensor([0, 1, 0, 1, 0, 1])
    renderer = RaycastRenderer(1, 1.0)
    images = torch.cat(
        [renderer(meshes[k], T[i : i + 1], K[None], SIZE).rgb for i, k in enumerate(which.tolist())]
    )
    start = Perturbation()(T, torch.zeros(6, 3), range(6))
    return PicturedObjects(images, K.expand(6, 3, 3), torch.arange(6), meshes, which), T, start


def some(pictured, rows):
    return pictured._replace(image_index=pictured.image_index[rows], mesh_index=pictured.mesh_index[rows])


def stirred(head="pose", views=4):
    """An untrained network whose output depends on the pictures."""
    network = MegaPoseNetwork(head, views, width=4, seed=0).eval()
    last = network.pose_fc if head == "pose" else network.views_logits_head
    with torch.no_grad():
        last.weight.normal_(
            0.0, 0.002 if head == "pose" else 0.02, generator=torch.Generator().manual_seed(1)
        )
    return network


def small_refiner(**changes):
    settings = {
        "network": stirred(),
        "renderer": RaycastRenderer(1, 1.0),
        "iterations": 2,
        "resolution": SMALL,
    }
    return MegaPoseRefiner(**(settings | changes))


class Oracle(MegaPoseRefiner):
    """Predicts half of the update that leads to given poses."""

    def predict(self, views):
        update = update_between(views.T_view_from_model, self.T_true, views.K, views.centre)
        identity = update.new_tensor([0, 0, 1.0, 1, 0, 0, 0, 1, 0])
        return identity + 0.5 * (update - identity), None


def distance(T_a, T_b, pictured):
    points = torch.stack([mesh.vertices[::20] for mesh in pictured.meshes])[pictured.mesh_index]
    return (transform_points(T_a, points) - transform_points(T_b, points)).norm(dim=-1).mean(-1)


@torch.no_grad()
def test_oracle_reaches_the_truth(scene):
    pictured, T_true, start = scene
    refiner = Oracle(stirred(), RaycastRenderer(1, 1.0), 5, resolution=SMALL)
    refiner.T_true = T_true
    found = refiner.refine(start, pictured)
    assert found.valid.all()
    assert found.logit is None
    assert (
        distance(found.T_camera_from_model, T_true, pictured) < 0.1 * distance(start, T_true, pictured)
    ).all()


@torch.no_grad()
def test_at_the_true_pose_crop_and_first_rendering_agree(scene):
    """But for the half pixel: moved back by it they agree better."""
    pictured, T_true, _ = scene
    views = small_refiner(resolution=SIZE).look(T_true, pictured)
    crop, rendering = views.crops[..., 1:-1, 1:-1], views.renderings[:, :3]
    inner = rendering[..., 1:-1, 1:-1]
    # The rendering shows at pixel j what the crop shows at j + 1/2.
    back = 0.25 * sum(rendering[..., a : a - 2 or None, b : b - 2 or None] for a in (0, 1) for b in (0, 1))
    off, on = (crop - inner).abs().mean(), (crop - back).abs().mean()
    assert on < 0.02
    assert on < off


@torch.no_grad()
def test_each_view_shows_what_it_should(scene):
    pictured, T_true, _ = scene
    views = small_refiner().look(T_true, pictured)
    seen = views.renderings.unflatten(1, (4, 2, 3))
    colors, normals = seen.unbind(2)
    covered = (colors > 0).any(2) | (normals > 0).any(2)
    assert (covered.flatten(2).float().mean(-1) > 0.1).all()
    # The four views differ, and colours and normals cover the same pixels but for the edges.
    assert all((colors[:, 0] - colors[:, k]).abs().mean() > 1e-3 for k in (1, 2, 3))
    assert ((colors > 0).any(2) == (normals > 0).any(2)).float().mean() > 0.97


@torch.no_grad()
def test_a_pose_is_refined_alone_as_in_a_batch(scene):
    pictured, _, start = scene
    refiner = small_refiner()
    together = refiner.refine(start, pictured)
    for i in range(6):
        alone = refiner.refine(start[i : i + 1], some(pictured, [i]))
        torch.testing.assert_close(
            alone.T_camera_from_model[0], together.T_camera_from_model[i], rtol=1e-4, atol=1e-2
        )
    # More than are refined at a time.
    rows = torch.arange(6).repeat(4)
    many = refiner.refine(start[rows], some(pictured, rows))
    torch.testing.assert_close(
        many.T_camera_from_model, together.T_camera_from_model[rows], rtol=1e-4, atol=1e-2
    )


@torch.no_grad()
def test_units_do_not_matter(scene):
    pictured, _, start = scene
    metres = [Mesh(m.vertices * 1e-3, m.faces, m.vertex_colors) for m in pictured.meshes]
    in_metres = start.clone()
    in_metres[:, :3, 3] *= 1e-3
    ours = small_refiner().refine(start, pictured).T_camera_from_model
    theirs = small_refiner(metres=1.0).refine(in_metres, pictured._replace(meshes=metres)).T_camera_from_model
    theirs[:, :3, 3] *= 1e3
    torch.testing.assert_close(theirs, ours, rtol=1e-3, atol=0.1)


@torch.no_grad()
def test_poses_that_cannot_be_rendered_come_back(scene):
    pictured, _, start = scene
    bad = start.clone()
    bad[0, 2, 3] = -400.0  # behind the camera
    bad[1, 0, 0] = torch.nan
    bad[2, :3, :3] = 0.0
    bad[3, 0, 3] = 1e5  # outside the picture
    found = small_refiner().refine(bad, pictured)
    assert found.valid.tolist() == [False] * 4 + [True] * 2
    torch.testing.assert_close(found.T_camera_from_model[:4], bad[:4], rtol=0, atol=0, equal_nan=True)
    good = small_refiner().refine(start, pictured).T_camera_from_model
    torch.testing.assert_close(found.T_camera_from_model[4:], good[4:], rtol=1e-4, atol=1e-2)
    nothing = small_refiner().refine(start[:0], some(pictured, []))
    assert nothing.T_camera_from_model.shape == (0, 4, 4)


@torch.no_grad()
def test_scorer_scores_and_moves_nothing(scene):
    pictured, _, start = scene
    network = stirred("score", 1)
    scorer = MegaPoseScorer(network, RaycastRenderer(1, 1.0), resolution=SMALL)
    found = scorer.refine(start, pictured)
    assert torch.equal(found.T_camera_from_model, start)
    views = scorer.look(start, pictured)
    assert views.renderings.shape == (6, 6, *SMALL)
    expected = network(torch.cat([views.crops, views.renderings], 1))[:, 0]
    torch.testing.assert_close(found.logit, expected)
    assert len(found.logit.unique()) == 6


def test_gradient_of_one_iteration_and_of_all(scene):
    pictured, _, start = scene
    pictured, start = some(pictured, [0, 1]), start[:2]
    for keep_graph in (False, True):
        refiner = small_refiner(keep_graph=keep_graph)
        T = start.clone().requires_grad_()
        moved = refiner.refine(T, pictured).T_camera_from_model
        moved[:, :3].square().sum().backward()
        assert all(torch.isfinite(p.grad).all() for p in refiner.network.parameters() if p.grad is not None)
        assert refiner.network.backbone.conv1.weight.grad.abs().sum() > 0
        assert (T.grad is not None and bool((T.grad.abs().sum((1, 2)) > 0).all())) == keep_graph


def test_meshes_are_set_up_once(scene, monkeypatch):
    pictured, _, start = scene
    meshes = [procedural_mesh(seed, subdivisions=2) for seed in range(10, 16)]
    refiner = small_refiner()
    pictured = pictured._replace(meshes=meshes, mesh_index=torch.arange(6))
    built = []
    build = RayScene.__init__
    monkeypatch.setattr(RayScene, "__init__", lambda self, mesh: (built.append(mesh), build(self, mesh))[0])
    with torch.no_grad():
        refiner.refine(start, pictured)
        refiner.refine(start, pictured)
    assert len(built) == 6


def test_bad_settings():
    with pytest.raises(ValueError, match="views 1 or 4"):
        small_refiner(network=MegaPoseNetwork("pose", 2, 4, seed=0))
    with pytest.raises(ValueError, match="metres must be positive"):
        small_refiner(metres=0.0)
    with pytest.raises(ValueError, match="head=score"):
        MegaPoseScorer(stirred(), RaycastRenderer(1, 1.0))
    with pytest.raises(AttributeError):
        MegaPoseRefiner(nn.Identity(), RaycastRenderer(1, 1.0))

import torch

from foundpose.geometry import project_points, transform_points
from foundpose.rendering import RaycastRenderer
from foundpose.synthetic import cluttered_scene, procedural_mesh


def test_objects_differ_by_seed_and_are_reproducible():
    first, again, other = (procedural_mesh(seed, subdivisions=4) for seed in (1, 1, 2))
    assert first.checksum == again.checksum
    assert first.checksum != other.checksum
    assert 120 <= first.diameter < 200
    assert first.vertex_colors.std(dim=0).min() > 0.1


def test_scene_shows_the_object_at_its_pose():
    mesh = procedural_mesh(4, subdivisions=5)
    scene = cluttered_scene(mesh, seed=11)
    again = cluttered_scene(mesh, seed=11)
    assert all(torch.equal(a, b) for a, b in zip(scene, again, strict=True))
    assert scene.image.min() >= 0
    assert scene.image.max() <= 1
    R = scene.T_camera_from_model[:3, :3]
    assert torch.allclose(R @ R.T, torch.eye(3), atol=1e-5)
    assert torch.det(R) > 0
    pixels, depth = project_points(transform_points(scene.T_camera_from_model, mesh.vertices), scene.K)
    assert (depth > 0).all()
    # Every visible pixel lies in the box of the projected vertices; an eighth of the object is hidden.
    rows, columns = torch.nonzero(scene.mask, as_tuple=True)
    low, high = pixels.amin(0) - 0.5, pixels.amax(0) + 0.5
    assert (columns >= low[0]).all()
    assert (columns <= high[0]).all()
    assert (rows >= low[1]).all()
    assert (rows <= high[1]).all()
    whole = cluttered_scene(mesh, seed=11, occlusion=False)
    assert 0.75 < scene.mask.sum() / whole.mask.sum() < 0.92
    # The light differs from the templates', the colours are still the object's.
    render = RaycastRenderer()(mesh, scene.T_camera_from_model[None], scene.K[None], (480, 640)).rgb[0]
    ours, theirs = whole.image[:, whole.mask].flatten(), render[:, whole.mask].flatten()
    assert abs(ours.mean() / theirs.mean() - 1) > 0.02
    assert torch.corrcoef(torch.stack([ours, theirs]))[0, 1] > 0.9

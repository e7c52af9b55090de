import numpy as np
import pytest
import torch
import trimesh

from foundpose.geometry import intrinsics_matrix, make_transform, project_points
from foundpose.rendering import Mesh
from foundpose.visualization.scene import GLTF_FROM_CAMERA, write_scene
from tests.pipeline.test_foundpose import pose_at

K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)
IMAGE = torch.linspace(0, 1, 3 * 48 * 64).reshape(3, 48, 64)


def in_camera(scene, name):
    """Vertices of a geometry in the camera's frame, as a viewer places them."""
    transform, geometry = scene.graph.get(name)
    placed = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
    return trimesh.transform_points(placed, np.linalg.inv(GLTF_FROM_CAMERA))


def test_the_scene_reads_back_with_objects_where_their_poses_say(blob, tmp_path):
    T = torch.stack([pose_at(blob, (180.0, 150.0), 700.0, 1), pose_at(blob, (430.0, 300.0), 900.0, 2)])
    write_scene(tmp_path / "scene.glb", IMAGE, K, [(blob, T[0]), (blob, T[1])])
    scene = trimesh.load(tmp_path / "scene.glb")
    assert {"picture", "camera", "object_0", "object_1"} <= set(scene.graph.nodes_geometry)
    for number in range(2):
        expected = trimesh.transform_points(blob.vertices.numpy(), T[number].numpy())
        assert np.abs(in_camera(scene, f"object_{number}") - expected).max() < 0.01
    colors = scene.geometry[scene.graph.get("object_0")[1]].visual.vertex_colors[:, :3] / 255.0
    assert np.abs(colors - blob.vertex_colors.numpy()).max() < 0.01


def test_the_picture_spans_its_pixels_behind_the_objects(blob, tmp_path):
    T = pose_at(blob, (180.0, 150.0), 700.0, 1)
    write_scene(tmp_path / "scene.glb", IMAGE, K, [(blob, T)])
    scene = trimesh.load(tmp_path / "scene.glb")
    corners = torch.from_numpy(in_camera(scene, "picture"))
    pixels = project_points(corners, K.double())[0]
    assert torch.allclose(pixels.amin(0), torch.tensor([-0.5, -0.5]).double(), atol=1e-3)
    assert torch.allclose(pixels.amax(0), torch.tensor([63.5, 47.5]).double(), atol=1e-3)
    assert corners[:, 2].min() > in_camera(scene, "object_0")[:, 2].max()
    geometry = scene.geometry[scene.graph.get("picture")[1]]
    texture = np.asarray(geometry.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(texture, (IMAGE * 255).round().byte().permute(1, 2, 0).numpy())
    # The upper left corner of the picture is the upper left corner of its texture.
    upper_left = int(pixels.sum(1).argmin())
    assert np.allclose(geometry.visual.uv[upper_left], [0, 1])
    lines = scene.geometry[scene.graph.get("camera")[1]]
    assert np.abs(lines.vertices).min(axis=0).max() < 1e-6  # from the camera's centre
    assert len(lines.vertices) >= 5


def test_textures_come_along_and_objects_behind_the_camera_are_refused(tmp_path):
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    texture = torch.rand(3, 4, 4)
    mesh = Mesh(corners, faces, uv=torch.rand(4, 2), texture=texture)
    T = make_transform(torch.eye(3), torch.tensor([0.0, 0.0, 5.0]))
    write_scene(tmp_path / "scene.glb", IMAGE, K, [(mesh, T)])
    scene = trimesh.load(tmp_path / "scene.glb")
    found = scene.geometry[scene.graph.get("object_0")[1]].visual
    assert np.allclose(found.uv, mesh.uv.numpy(), atol=1e-6)
    stored = np.asarray(found.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(stored, (texture * 255).round().byte().permute(1, 2, 0).numpy())
    T[2, 3] = -5.0
    with pytest.raises(ValueError, match="object 0 lies behind the camera"):
        write_scene(tmp_path / "other.glb", IMAGE, K, [(mesh, T)])

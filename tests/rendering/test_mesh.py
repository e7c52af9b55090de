"""Mesh loading, checks and sizes."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.distance import pdist
from trimesh.visual.color import linear_to_srgb

from foundpose.geometry.cameras import intrinsics_matrix
from foundpose.rendering import Mesh, MeshError, RaycastRenderer, load_mesh
from tests.rendering.scenes import look_at, square

QUADRANTS = {(20, 20): (1, 0, 0), (20, 44): (0, 1, 0), (44, 20): (0, 0, 1), (44, 44): (1, 1, 0)}
K = intrinsics_matrix(200.0, 200.0, 31.5, 31.5)[None]


def quadrant_image() -> Image.Image:
    small = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
    return Image.fromarray(small.repeat(32, 0).repeat(32, 1))


def assert_quadrants(mesh: Mesh) -> None:
    """The square of 2 units, seen from z < 0 with y down, shows the image upright."""
    rgb = RaycastRenderer()(mesh, look_at(10.0), K, (64, 64)).rgb[0]
    for (v, u), color in QUADRANTS.items():
        torch.testing.assert_close(rgb[:, v, u], torch.tensor(color).float(), atol=0.01, rtol=0)


def textured_square(material: trimesh.visual.material.Material) -> trimesh.Trimesh:
    mesh = square(textured=torch.zeros(3, 1, 1))
    visual = trimesh.visual.TextureVisuals(uv=mesh.uv.numpy(), material=material)
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), visual=visual, process=False)


def box(**settings: object) -> trimesh.Trimesh:
    return trimesh.creation.box((10.0, 20.0, 30.0), **settings)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb", "off"])
def test_geometry_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box.{suffix}"
    box().export(path)
    mesh = load_mesh(path)
    assert len(mesh.faces) == 12
    torch.testing.assert_close(mesh.bounds, torch.tensor([[-5.0, -10.0, -15.0], [5.0, 10.0, 15.0]]))
    assert mesh.diameter == pytest.approx(np.sqrt(1400.0), rel=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_vertex_colours_round_trip(tmp_path: Path, suffix: str) -> None:
    colors = np.random.default_rng(0).integers(0, 255, (8, 4), dtype=np.uint8)
    colors[:, 3] = 255
    original = trimesh.Trimesh(box().vertices, box().faces, vertex_colors=colors, process=False)
    path = tmp_path / f"box.{suffix}"
    original.export(path)
    mesh = load_mesh(path)
    nearest = torch.cdist(mesh.vertices.double(), torch.tensor(original.vertices)).argmin(1)
    expected = colors[nearest, :3] / 255.0
    if suffix == "glb":  # whose numbers are light
        expected = linear_to_srgb(expected)
    torch.testing.assert_close(mesh.vertex_colors, torch.tensor(expected).float(), atol=2e-3, rtol=0)


def test_obj_texture(tmp_path: Path) -> None:
    quad = textured_square(trimesh.visual.material.SimpleMaterial(image=quadrant_image()))
    quad.export(tmp_path / "quad.obj")
    assert list(tmp_path.glob("*.mtl"))
    assert_quadrants(load_mesh(tmp_path / "quad.obj"))


def test_glb_texture_under_a_node_transform(tmp_path: Path) -> None:
    quad = textured_square(trimesh.visual.material.PBRMaterial(baseColorTexture=quadrant_image()))
    quad.apply_scale(0.5)
    scene = trimesh.Scene()
    scene.add_geometry(quad, transform=np.diag([2.0, 2.0, 2.0, 1.0]))
    scene.export(tmp_path / "quad.glb")
    assert_quadrants(load_mesh(tmp_path / "quad.glb"))


def test_glb_base_color_factor(tmp_path: Path) -> None:
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[51, 102, 255, 255])
    textured_square(material).export(tmp_path / "quad.glb")
    mesh = load_mesh(tmp_path / "quad.glb")
    torch.testing.assert_close(
        mesh.vertex_colors, torch.tensor([[0.4845, 0.6652, 1.0]]).repeat(4, 1), atol=2e-4, rtol=0
    )


def test_scene_with_several_materials(tmp_path: Path) -> None:
    image = quadrant_image()
    scene = trimesh.Scene(textured_square(trimesh.visual.material.PBRMaterial(baseColorTexture=image)))
    blue = Image.fromarray(np.full((16, 16, 3), (0, 0, 255), np.uint8))
    moved = trimesh.transformations.translation_matrix([0.0, 0.0, 50.0])
    scene.add_geometry(
        textured_square(trimesh.visual.material.PBRMaterial(baseColorTexture=blue)), transform=moved
    )
    plain = box(transform=trimesh.transformations.translation_matrix([0.0, 0.0, 100.0]))
    plain.visual = trimesh.visual.ColorVisuals(plain, vertex_colors=np.tile([255, 0, 0, 255], (8, 1)))
    scene.add_geometry(plain)
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert len(mesh.faces) == 2 + 2 + 12
    assert_quadrants(mesh)
    T = look_at(10.0)
    T[:, 2, 3] -= 50.0  # the first square is behind the camera, the second in front
    centre = RaycastRenderer()(mesh, T, K, (64, 64)).rgb[0, :, 32, 32]
    torch.testing.assert_close(centre, torch.tensor([0.0, 0.0, 1.0]), atol=0.02, rtol=0)
    T[:, 2, 3] -= 50.0
    T[:, 2, 3] += 20.0
    centre = RaycastRenderer()(mesh, T, K, (64, 64)).rgb[0, :, 32, 32]
    torch.testing.assert_close(centre, torch.tensor([1.0, 0.0, 0.0]), atol=0.02, rtol=0)


@pytest.mark.parametrize("layout", ["vertex", "face"])
def test_ply_texture_file(tmp_path: Path, layout: str) -> None:
    """The two ways in which PLY files carry texture coordinates; BOP's have them at the vertices."""
    quadrant_image().save(tmp_path / "my texture.png")
    mesh = square(textured=torch.zeros(3, 1, 1))
    at_vertex = layout == "vertex"
    lines = ["ply", "format ascii 1.0", "comment TextureFile my texture.png", "element vertex 4"]
    lines += [f"property float {name}" for name in "xyz"]
    lines += ["property float texture_u", "property float texture_v"] if at_vertex else []
    lines += ["element face 2", "property list uchar int vertex_indices"]
    lines += [] if at_vertex else ["property list uchar float texcoord"]
    lines += ["end_header"]
    for position, uv in zip(mesh.vertices.tolist(), mesh.uv.tolist(), strict=True):
        lines.append(" ".join(map(str, position + (uv if at_vertex else []))))
    for face in mesh.faces.tolist():
        corners = [value for index in face for value in mesh.uv[index].tolist()]
        lines.append(" ".join(map(str, [3, *face] + ([] if at_vertex else [6, *corners]))))
    (tmp_path / "quad.ply").write_text("\n".join(lines) + "\n")
    loaded = load_mesh(tmp_path / "quad.ply")
    assert loaded.texture is not None
    assert_quadrants(loaded)


def test_missing_texture_is_warned_about(tmp_path: Path) -> None:
    quad = textured_square(trimesh.visual.material.SimpleMaterial(image=quadrant_image()))
    quad.export(tmp_path / "quad.obj")
    for image in [*tmp_path.glob("*.png"), *tmp_path.glob("*.jp*g")]:
        image.unlink()
    with pytest.warns(UserWarning, match="texture image was not found"):
        mesh = load_mesh(tmp_path / "quad.obj")
    assert mesh.texture is None


def test_broken_and_missing_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply"):
        load_mesh(tmp_path / "nowhere.ply")
    broken = tmp_path / "broken.ply"
    box().export(broken)
    broken.write_bytes(broken.read_bytes()[:180])
    with pytest.raises(MeshError, match=r"broken\.ply"):
        load_mesh(broken)
    (tmp_path / "noise.glb").write_bytes(b"not a mesh at all")
    with pytest.raises(MeshError, match="cannot be read"):
        load_mesh(tmp_path / "noise.glb")
    (tmp_path / "mesh.xyzabc").write_bytes(b"?")
    with pytest.raises(MeshError, match="suffix"):
        load_mesh(tmp_path / "mesh.xyzabc")


def test_point_cloud_and_empty_mesh(tmp_path: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((20, 3))).export(tmp_path / "cloud.ply")
    with pytest.raises(MeshError, match="no triangles"):
        load_mesh(tmp_path / "cloud.ply")
    with pytest.raises(MeshError, match="empty"):
        Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))


def write_off(path: Path, vertices: object, faces: object) -> Path:
    body = [f"{len(vertices)} {len(faces)} 0"]
    body += [" ".join(map(str, v)) for v in vertices]
    body += ["3 " + " ".join(map(str, f)) for f in faces]
    path.write_text("OFF\n" + "\n".join(body) + "\n")
    return path


def test_bad_coordinates(tmp_path: Path) -> None:
    vertices = box().vertices.tolist()
    vertices[3][1] = float("nan")
    with pytest.raises(MeshError, match=r"bad\.off.*1 of 8 vertices"):
        load_mesh(write_off(tmp_path / "bad.off", vertices, box().faces.tolist()))
    with pytest.raises(MeshError, match="no extent"):
        load_mesh(write_off(tmp_path / "point.off", np.ones((8, 3)).tolist(), box().faces.tolist()))
    line = [[float(i), 2.0 * i, 0.0] for i in range(8)]
    with pytest.raises(MeshError, match="degenerate"):
        load_mesh(write_off(tmp_path / "line.off", line, box().faces.tolist()))
    with pytest.raises(MeshError, match="refer to vertices 0 to 7, but there are 4"):
        Mesh(torch.rand(4, 3), torch.tensor(box().faces))


def test_wrong_appearance() -> None:
    vertices, faces = square().vertices, square().faces
    with pytest.raises(MeshError, match=r"vertex_colors must have shape \(4, 3\), got \(3, 3\)"):
        Mesh(vertices, faces, vertex_colors=torch.zeros(3, 3))
    with pytest.raises(MeshError, match=r"texture must have shape \(3, h, w\)"):
        Mesh(vertices, faces, uv=torch.zeros(4, 2), texture=torch.zeros(4, 4))
    with pytest.raises(MeshError, match="uv is missing"):
        Mesh(vertices, faces, texture=torch.zeros(3, 4, 4))


def test_degenerate_duplicate_and_unused_parts_are_dropped(tmp_path: Path) -> None:
    vertices = [*box().vertices.tolist(), [1000.0, 0.0, 0.0]]
    faces = [*box().faces.tolist(), [0, 0, 1], box().faces[0].tolist()[::-1]]
    with pytest.warns(UserWarning, match="dropped 1 degenerate and 1 duplicate"):
        mesh = load_mesh(write_off(tmp_path / "box.off", vertices, faces))
    assert len(mesh.vertices) == 8
    assert len(mesh.faces) == 12
    assert mesh.diameter == pytest.approx(np.sqrt(1400.0), rel=1e-6)


def test_non_manifold_edges_are_warned_about(tmp_path: Path) -> None:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
    with pytest.warns(UserWarning, match=r"1 of 7 edges are not manifold"):
        load_mesh(write_off(tmp_path / "fan.off", vertices, [[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # an open surface is no reason to warn
        load_mesh(write_off(tmp_path / "open.off", vertices[:4], [[0, 1, 2], [0, 1, 3]]))


def test_absurd_scale(tmp_path: Path) -> None:
    tiny = box()
    tiny.apply_scale(1e-6)
    tiny.export(tmp_path / "tiny.ply")
    with pytest.warns(UserWarning, match="very small.*kilometres"):
        load_mesh(tmp_path / "tiny.ply")
    huge = box()
    huge.apply_scale(1e5)
    huge.export(tmp_path / "huge.stl")
    with pytest.warns(UserWarning, match="very large.*micrometres"):
        load_mesh(tmp_path / "huge.stl")


def test_diameter_is_the_largest_vertex_distance() -> None:
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(0)) * 3 + 1000.0
    faces = torch.arange(300).reshape(100, 3)
    mesh = Mesh(points, faces)
    assert mesh.diameter == pytest.approx(pdist(points.double().numpy()).max(), rel=1e-9)
    assert square(2.0).diameter == pytest.approx(np.sqrt(8.0), rel=1e-6)  # flat: the hull has no volume
    R = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    flat = Mesh(points * torch.tensor([1.0, 1.0, 0.0]) @ R, faces)
    assert flat.diameter == pytest.approx(pdist(flat.vertices.double().numpy()).max(), rel=1e-5)


def test_lmo_diameters_and_silence(lmo_root: Path) -> None:
    import json

    info = json.loads((lmo_root / "models" / "models_info.json").read_text())
    for object_id in ("1", "5"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            mesh = load_mesh(lmo_root / "models" / f"obj_{int(object_id):06d}.ply")
        assert mesh.diameter == pytest.approx(info[object_id]["diameter"], rel=1e-4)
        assert mesh.vertex_colors is not None


def test_normals_of_a_smooth_and_of_a_given_surface() -> None:
    sphere = trimesh.creation.icosphere(3)
    mesh = Mesh(torch.tensor(sphere.vertices), torch.tensor(sphere.faces))
    assert (mesh.vertex_normals * mesh.vertices).sum(-1).min() > 0.999
    seamed = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), torch.arange(mesh.faces.numel()).reshape(-1, 3))
    torch.testing.assert_close(seamed.vertex_normals, mesh.vertex_normals[mesh.faces].reshape(-1, 3))
    given = Mesh(mesh.vertices, mesh.faces, vertex_normals=5.0 * mesh.vertices)
    torch.testing.assert_close(given.vertex_normals, mesh.vertices, atol=1e-5, rtol=0)


def test_a_cube_is_shaded_flat() -> None:
    cube = trimesh.creation.box((2.0, 2.0, 2.0))  # eight vertices, shared by three sides each
    mesh = Mesh(torch.tensor(cube.vertices), torch.tensor(cube.faces))
    out = RaycastRenderer()(mesh, look_at(10.0), K, (64, 64))
    face_on = torch.tensor([0.0, 0.0, -1.0])[:, None].expand(3, int(out.mask.sum()))
    torch.testing.assert_close(out.normals[0][:, out.mask[0]], face_on, atol=1e-6, rtol=0)


def test_checksum_depends_on_content_alone() -> None:
    def make(shift: float = 0.0, color: float = 0.5, texel: float = 0.5) -> Mesh:
        return Mesh(
            square().vertices + shift,
            square().faces,
            vertex_colors=torch.full((4, 3), color),
            uv=torch.zeros(4, 2),
            texture=torch.full((3, 2, 2), texel),
        )

    assert make().checksum == make().checksum
    assert len(make().checksum) == 64
    assert (
        len({make().checksum, make(shift=1e-3).checksum, make(color=0.6).checksum, make(texel=0.6).checksum})
        == 4
    )

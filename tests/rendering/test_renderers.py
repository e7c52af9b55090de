"""Both renderers against closed forms and independent references."""

import copy
import pickle

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from foundpose.geometry.cameras import intrinsics_matrix, pixel_grid, pixel_rays
from foundpose.rendering import Mesh, RaycastRenderer, Renderer, load_mesh
from foundpose.rendering.shading import AMBIENT
from tests.rendering.scenes import (
    camera_filling,
    gl_renderer_or_skip,
    icosphere,
    look_at,
    random_poses,
    square,
    textured_torus,
)


def ray_triangle_depth(mesh: Mesh, T: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth by solving ray = plane for every pixel and face in float64 (Möller and Trumbore); 0 is a miss."""
    rays = pixel_rays(pixel_grid(*size, torch.device("cpu"), torch.float64), torch.from_numpy(K)).numpy()
    triangles = (mesh.vertices.double().numpy() @ T[:3, :3].T + T[:3, 3])[mesh.faces.numpy()]
    best = np.full(size, np.inf)
    for a, b, c in triangles:
        p = np.cross(rays, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (p @ -a) / (p @ (b - a))
            q = np.cross(-a, b - a)
            v = (rays @ q) / (p @ (b - a))
            t = ((c - a) @ q) / (p @ (b - a))
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best)
        best[hit] = t[hit]
    return np.where(np.isinf(best), 0.0, best)


def test_square_pins_the_pixel_convention(renderer: Renderer) -> None:
    # The square's edges project to u = cx ± 20, v = cy ± 20 exactly; pixels are centred at integers.
    K = intrinsics_matrix(100.0, 100.0, 31.75, 24.25)[None]
    out = renderer(square(side=4.0), look_at(10.0), K, (50, 64))
    v, u = torch.nonzero(out.mask[0], as_tuple=True)
    assert (u.min(), u.max(), v.min(), v.max()) == (12, 51, 5, 44)
    weight = out.rgb[0].mean(0)
    grid = pixel_grid(50, 64, torch.device("cpu"), torch.float32)
    centroid = (grid * weight[..., None]).sum((0, 1)) / weight.sum()
    # Whole samples of 0.5 px: the edges at .75 and .25 fall between samples at .25 and .75 or on one.
    torch.testing.assert_close(centroid, torch.tensor([31.75, 24.25]), atol=0.26, rtol=0)
    K_exact = intrinsics_matrix(100.0, 100.0, 31.5, 24.5)[None]
    weight = renderer(square(side=4.0), look_at(10.0), K_exact, (50, 64)).rgb[0].mean(0)
    centroid = (grid * weight[..., None]).sum((0, 1)) / weight.sum()
    torch.testing.assert_close(centroid, torch.tensor([31.5, 24.5]), atol=1e-3, rtol=0)


def test_tilted_plane_depth_normal_and_light(renderer: Renderer) -> None:
    angle = torch.tensor(0.6, dtype=torch.float64)
    T = look_at(10.0, torch.float64)
    T[0, 0, 0] = T[0, 2, 2] = torch.cos(angle)
    T[0, 0, 2], T[0, 2, 0] = torch.sin(angle), -torch.sin(angle)
    K = intrinsics_matrix(120.0, 110.0, 40.0, 30.0).double()[None]
    out = renderer(square(side=6.0, colors=torch.full((4, 3), 0.5)), T, K, (60, 80))
    normal = T[0, :3, 2]  # of the plane, in the camera frame
    rays = pixel_rays(pixel_grid(60, 80, torch.device("cpu"), torch.float64), K[0])
    depth = (normal @ T[0, :3, 3]) / (rays @ normal)
    mask = out.mask[0]
    assert mask.sum() > 1000
    torch.testing.assert_close(out.depth[0][mask], depth[mask], rtol=1e-6, atol=0)
    expected = -normal[:, None].expand(3, int(mask.sum()))
    torch.testing.assert_close(out.normals[0][:, mask], expected, atol=1e-6, rtol=0)
    inside = torch.from_numpy(binary_erosion(mask.numpy(), iterations=2))
    shade = 0.5 * (AMBIENT + (1 - AMBIENT) * torch.cos(angle))
    torch.testing.assert_close(out.rgb[0][:, inside], shade.expand(3, int(inside.sum())), atol=1e-5, rtol=0)
    assert not out.depth[0][~mask].any()
    assert not out.normals[0][:, ~mask].any()


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_sphere_depth_in_closed_form(renderer: Renderer, unit: float) -> None:
    mesh = icosphere(radius=unit)
    K = intrinsics_matrix(300.0, 300.0, 63.5, 63.5)[None]
    out = renderer(mesh, look_at(6.0 * unit), K, (128, 128))
    rays = pixel_rays(pixel_grid(128, 128, torch.device("cpu"), torch.float32), K[0])
    a, b, c = rays.square().sum(-1), -2 * 6.0 * rays[..., 2], 35.0
    root = b.square() - 4 * a * c
    depth = (-b - root.clamp_min(0).sqrt()) / (2 * a) * unit
    well_inside = root > 0.15 * root.max()
    assert out.mask[0][well_inside].all()
    assert abs(int(out.mask.sum()) - int((root > 0).sum())) < 0.01 * int((root > 0).sum())
    torch.testing.assert_close(out.depth[0][well_inside], depth[well_inside], rtol=3e-4, atol=0)
    outward = rays * (depth / unit)[..., None] - torch.tensor([0.0, 0.0, 6.0])
    cosine = (out.normals[0].permute(1, 2, 0) * outward).sum(-1)
    assert cosine[well_inside].min() > 0.999


def test_depth_equals_brute_force(renderer: Renderer) -> None:
    sphere = icosphere(subdivisions=2)
    noise = torch.rand(sphere.vertices.shape, generator=torch.Generator().manual_seed(1))
    mesh = Mesh(sphere.vertices + 0.3 * noise + 50.0, sphere.faces)  # off the origin, self-occluding
    T = random_poses(3, 4.0, centre=mesh.bounds.mean(0))
    T[:, :3, 0] *= 1.004  # BOP's published rotations are not exactly orthonormal
    K = intrinsics_matrix(90.0, 95.0, 30.3, 23.1).double()
    out = renderer(mesh, T, K[None], (48, 64))
    for i in range(3):
        expected = ray_triangle_depth(mesh, T[i].numpy(), K.numpy(), (48, 64))
        mask = out.mask[i].numpy()
        assert (mask != (expected > 0)).sum() <= 2  # rays that graze an edge
        both = mask & (expected > 0)
        assert both.sum() > 800
        error = np.abs(out.depth[i].numpy() - expected)[both]
        assert np.quantile(error, 0.99) < 1e-5
        assert (error > 1e-3).sum() <= 2


def test_far_camera_keeps_accuracy() -> None:
    mesh = icosphere(subdivisions=3)
    T = random_poses(1, 5000.0)
    K = intrinsics_matrix(60000.0, 60000.0, 15.5, 15.5).double()
    out = RaycastRenderer()(mesh, T, K[None], (32, 32))
    expected = ray_triangle_depth(mesh, T[0].numpy(), K.numpy(), (32, 32))
    both = out.mask[0].numpy() & (expected > 0)
    assert both.sum() > 300
    assert np.abs(out.depth[0].numpy() - expected)[both].max() < 1e-4


def test_vertex_colours_interpolate(renderer: Renderer) -> None:
    colors = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1.0, 1.0]])
    K = intrinsics_matrix(200.0, 200.0, 31.5, 31.5)[None]
    rgb = renderer(square(side=2.0, colors=colors), look_at(10.0), K, (64, 64)).rgb[0]
    # Corners of the picture of the square (pixels 12 to 51): top left, top right, bottom right, bottom left.
    for color, (v, u) in zip(colors, [(12, 12), (12, 51), (51, 51), (51, 12)], strict=True):
        torch.testing.assert_close(rgb[:, v, u], color, atol=0.06, rtol=0)
    torch.testing.assert_close(rgb[:, 32, 31], torch.tensor([0.5, 0.0, 0.5]), atol=0.03, rtol=0)


def test_texture_is_the_right_way_up(renderer: Renderer) -> None:
    quadrants = torch.tensor(
        [[[1.0, 0], [0, 1]], [[0, 1], [0, 1]], [[0, 0], [1, 0]]]
    )  # red green / blue yellow
    texture = quadrants.repeat_interleave(32, 1).repeat_interleave(32, 2)
    K = intrinsics_matrix(200.0, 200.0, 31.5, 31.5)[None]
    rgb = renderer(square(textured=texture), look_at(10.0), K, (64, 64)).rgb[0]
    for color, (v, u) in zip(
        [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)], [(20, 20), (20, 44), (44, 20), (44, 44)], strict=True
    ):
        torch.testing.assert_close(rgb[:, v, u], torch.tensor(color).float(), atol=1e-4, rtol=0)
    tinted = square(textured=texture, colors=torch.tensor([[0.5, 1.0, 1.0]]).repeat(4, 1))
    rgb = renderer(tinted, look_at(10.0), K, (64, 64)).rgb[0]
    torch.testing.assert_close(rgb[:, 44, 44], torch.tensor([0.5, 1.0, 0.0]), atol=1e-4, rtol=0)


def test_texture_finer_than_the_image_is_averaged(renderer: Renderer) -> None:
    checker = (torch.arange(1024)[:, None] + torch.arange(1024)) % 2
    texture = checker.float().expand(3, -1, -1)
    K = intrinsics_matrix(203.0, 203.0, 31.3, 31.1)[None]
    rgb = renderer(square(textured=texture), look_at(10.0), K, (64, 64)).rgb[0]
    torch.testing.assert_close(rgb[:, 20:45, 20:45], torch.full((3, 25, 25), 0.5), atol=0.02, rtol=0)


def test_supersampling_reduces_aliasing() -> None:
    T = random_poses(1, 10.0)
    mesh, K = textured_torus(), intrinsics_matrix(110.0, 110.0, 47.5, 47.5)[None]
    images = {n: RaycastRenderer(supersampling=n)(mesh, T, K, (96, 96)) for n in (1, 2, 3, 8)}
    errors = [float((images[n].rgb - images[8].rgb).square().mean().sqrt()) for n in (1, 2, 3)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < errors[1]
    for n in (2, 3, 8):  # the pixel centre's ray does not depend on n
        torch.testing.assert_close(images[n].depth, images[1].depth, atol=1e-6, rtol=0)
        assert torch.equal(images[n].mask, images[1].mask)
        torch.testing.assert_close(images[n].normals, images[1].normals, atol=1e-4, rtol=0)


def compare(mesh: Mesh, count: int, size: int) -> None:
    T = random_poses(count, 6 * mesh.diameter, centre=mesh.bounds.mean(0)).float()
    K = camera_filling(mesh, 6 * mesh.diameter, size)
    a, b = RaycastRenderer()(mesh, T, K, (size, size)), gl_renderer_or_skip()(mesh, T, K, (size, size))
    for i in range(count):
        both, either = a.mask[i] & b.mask[i], a.mask[i] | b.mask[i]
        assert both.sum() > 0.05 * size**2
        assert both.sum() / either.sum() > 0.99
        # Away from silhouettes and from depth steps inside the object.
        depth = a.depth[i].numpy()
        step = np.maximum(np.abs(np.gradient(depth)[0]), np.abs(np.gradient(depth)[1]))
        smooth = binary_erosion(both.numpy() & (step < 0.02 * mesh.diameter), iterations=2)
        assert smooth.sum() > 0.4 * both.sum()
        relative = np.abs(a.depth[i].numpy() / np.maximum(b.depth[i].numpy(), 1e-9) - 1)[smooth]
        assert relative.max() < 1e-3
        difference = (a.rgb[i] - b.rgb[i]).abs().mean(0)[both]
        assert difference.mean() < 0.005
        cosine = (a.normals[i] * b.normals[i]).sum(0)[torch.from_numpy(smooth)]
        assert cosine.quantile(0.01) > 0.999


@pytest.mark.parametrize("object_id", [1, 5, 11])
def test_renderers_agree_on_lmo(lmo_root, object_id: int) -> None:
    compare(load_mesh(lmo_root / "models" / f"obj_{object_id:06d}.ply"), count=3, size=210)


def test_renderers_agree_on_a_textured_mesh() -> None:
    compare(textured_torus(), count=4, size=210)


def test_gl_sees_both_sides_and_switches_meshes_and_sizes() -> None:
    gl, ray = gl_renderer_or_skip(supersampling=1), RaycastRenderer(supersampling=1)
    K = intrinsics_matrix(100.0, 100.0, 15.5, 11.5)[None]
    back = look_at(5.0)
    back[0, 0, 0] = back[0, 2, 2] = -1.0  # turned about y: the square's back
    for mesh, size in [(square(), (24, 32)), (textured_torus(), (40, 20)), (square(), (24, 32))]:
        a, b = gl(mesh, back, K, size), ray(mesh, back, K, size)
        assert b.mask.any()
        assert (a.mask != b.mask).sum() <= 2
        torch.testing.assert_close(
            a.rgb[:, :, a.mask[0] & b.mask[0]], b.rgb[:, :, a.mask[0] & b.mask[0]], atol=0.02, rtol=0
        )


def test_batch_equals_single(renderer: Renderer) -> None:
    mesh = textured_torus()
    T = random_poses(5, 12.0)
    K = intrinsics_matrix(100.0, 100.0, 31.5, 31.5).double().repeat(5, 1, 1)
    K[:, 0, 0] += torch.arange(5) * 7.0
    batch = renderer(mesh, T, K, (64, 64))
    for i in (4, 0, 2):
        single = renderer(mesh, T[i : i + 1], K[i : i + 1], (64, 64))
        for a, b in zip(single, batch, strict=True):
            assert torch.equal(a[0], b[i])


def test_window_cuts_nothing_off() -> None:
    # The same rays through an image that shows a part only: partly out of view on each side.
    mesh, renderer, T = textured_torus(), RaycastRenderer(supersampling=1), random_poses(1, 9.0)
    K = intrinsics_matrix(150.0, 150.0, 63.5, 63.5).double()[None]
    full = renderer(mesh, T, K, (128, 128))
    K_part = K.clone()
    K_part[0, :2, 2] -= torch.tensor([40.0, 50.0])
    part = renderer(mesh, T, K_part, (30, 25))
    torch.testing.assert_close(part.depth[0], full.depth[0, 50:80, 40:65], atol=1e-5, rtol=0)
    assert part.mask.any()


def test_nothing_in_view_is_empty_not_an_error(renderer: Renderer) -> None:
    T = look_at(10.0).repeat(6, 1, 1)
    T[0, 2, 3] = -10.0  # behind
    T[1, 0, 3] = 500.0  # beside
    T[2, 1, 1] = float("nan")
    T[3, :3, :3] = 0.0
    K = intrinsics_matrix(100.0, 100.0, 15.5, 15.5).repeat(6, 1, 1)
    K[4, 0, 0] = float("inf")
    out = renderer(square(), T, K, (32, 32))
    assert not out.mask[:5].any()
    assert not out.rgb[:5].any()
    assert out.mask[5].any()
    assert all(torch.isfinite(part).all() for part in out)


def test_camera_inside_the_mesh_sees_its_walls() -> None:
    out = RaycastRenderer()(
        icosphere(), look_at(0.0), intrinsics_matrix(20.0, 20.0, 7.5, 7.5)[None], (16, 16)
    )
    assert out.mask.all()
    distance = out.depth[0] * torch.linalg.vector_norm(
        pixel_rays(
            pixel_grid(16, 16, torch.device("cpu"), torch.float32), intrinsics_matrix(20.0, 20.0, 7.5, 7.5)
        ),
        dim=-1,
    )
    torch.testing.assert_close(distance, torch.ones(16, 16), rtol=2e-3, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_output_contract(renderer: Renderer, dtype: torch.dtype) -> None:
    T = look_at(10.0, dtype).repeat(2, 1, 1).requires_grad_()
    out = renderer(square(), T, intrinsics_matrix(100.0, 100.0, 15.5, 7.5)[None], (16, 32))
    assert [tuple(part.shape) for part in out] == [(2, 3, 16, 32), (2, 16, 32), (2, 16, 32), (2, 3, 16, 32)]
    assert (out.rgb.dtype, out.depth.dtype, out.mask.dtype, out.normals.dtype) == (
        dtype,
        dtype,
        torch.bool,
        dtype,
    )
    assert not out.rgb.requires_grad
    length = torch.linalg.vector_norm(out.normals, dim=1)
    torch.testing.assert_close(length, out.mask.to(dtype), atol=1e-6, rtol=0)
    rays = pixel_rays(
        pixel_grid(16, 32, torch.device("cpu"), dtype), intrinsics_matrix(100.0, 100.0, 15.5, 7.5).to(dtype)
    )
    assert (torch.einsum("bchw,hwc->bhw", out.normals, rays)[out.mask] < 0).all()


def test_copies_and_pickles_work_on_their_own(renderer: Renderer) -> None:
    arguments = (square(), look_at(10.0), intrinsics_matrix(100.0, 100.0, 15.5, 15.5)[None], (32, 32))
    expected = renderer(*arguments)
    assert renderer.state_dict() == {}
    for other in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer))):
        for a, b in zip(other(*arguments), expected, strict=True):
            assert torch.equal(a, b)
        assert other.supersampling == renderer.supersampling


def test_bad_input_is_named() -> None:
    renderer, T, K = RaycastRenderer(), look_at(10.0), intrinsics_matrix(100.0, 100.0, 15.5, 15.5)[None]
    with pytest.raises(ValueError, match=r"\(B, 4, 4\), got \(4, 4\)"):
        renderer(square(), T[0], K, (32, 32))
    with pytest.raises(ValueError, match=r"B = 3, got \(2, 3, 3\)"):
        renderer(square(), T.repeat(3, 1, 1), K.repeat(2, 1, 1), (32, 32))
    with pytest.raises(ValueError, match="float16"):
        renderer(square(), T.half(), K, (32, 32))
    with pytest.raises(ValueError, match="size"):
        renderer(square(), T, K, (0, 32))
    with pytest.raises(ValueError, match="supersampling"):
        RaycastRenderer(supersampling=0)
    with pytest.raises(ValueError, match="ambient"):
        RaycastRenderer(ambient=1.5)


def test_missing_egl_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import builtins

    from foundpose.rendering import PyrenderRenderer

    real_import = builtins.__import__

    def without_pyrender(name: str, *arguments: object, **settings: object) -> object:
        if name.startswith("pyrender"):
            raise ImportError("Unable to load EGL library")
        return real_import(name, *arguments, **settings)

    monkeypatch.setattr(builtins, "__import__", without_pyrender)
    K = intrinsics_matrix(100.0, 100.0, 15.5, 15.5)[None]
    with pytest.raises(RuntimeError, match=r"apt-get install libegl1.*RaycastRenderer.*Unable to load EGL"):
        PyrenderRenderer()(square(), look_at(10.0), K, (32, 32))


def test_gl_refuses_skew() -> None:
    K = intrinsics_matrix(100.0, 100.0, 15.5, 15.5)[None]
    K[0, 0, 1] = 3.0
    with pytest.raises(ValueError, match="without skew"):
        gl_renderer_or_skip()(square(), look_at(10.0), K, (32, 32))

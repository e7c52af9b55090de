import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from foundpose.geometry import intrinsics_matrix, make_transform, project_points, transform_points
from foundpose.refinement import apply_update
from foundpose.refinement.megapose import (
    crop_boxes,
    crop_intrinsics,
    front_views,
    normal_colors,
    sample_boxes,
)
from foundpose.rendering import Mesh, RaycastRenderer
from tests.refinement.megapose import slow

SIZE = (240, 320)
K = torch.tensor([[610.0, 0.0, 322.3], [0.0, 580.0, 239.1], [0.0, 0.0, 1.0]], dtype=torch.float64)


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())
    return make_transform(R, torch.from_numpy(rng.uniform([-0.3, -0.2, 0.4], [0.3, 0.2, 1.5], (count, 3))))


def points(count=50, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.1, 0.15, (count, 3)))


@pytest.mark.parametrize(
    "closer", [0.0, 0.75]
)  # the second has points nearer than 0.1 m and behind the camera
def test_boxes_and_intrinsics_against_the_slow_ones(closer):
    T = poses(20)
    T[:, 2, 3] *= 1.0 - closer
    boxes = crop_boxes(points(), T, K, SIZE, near=0.1)
    cameras = crop_intrinsics(K, boxes, SIZE)
    for i in range(len(T)):
        expected = slow.crop_box(points().tolist(), K.tolist(), T[i].tolist())
        np.testing.assert_allclose(boxes[i], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            cameras[i], slow.crop_intrinsics(K.tolist(), expected), rtol=1e-9, atol=1e-9
        )


def test_crops_show_the_origin_in_their_middle_and_the_object_with_its_margin():
    T = poses(20, seed=1)
    cameras = crop_intrinsics(K, crop_boxes(points(), T, K, SIZE, near=0.1), SIZE)
    origin = project_points(T[:, None, :3, 3], cameras)[0]
    torch.testing.assert_close(origin[:, 0], torch.tensor([159.5, 119.5]).double().expand(20, 2))
    reach = (project_points(transform_points(T, points()), cameras)[0] - origin).abs().amax(1)
    share = 1.4 * reach / torch.tensor([160.0, 120.0])
    torch.testing.assert_close(share.amax(-1), torch.ones(20).double())


def test_a_point_of_the_picture_lies_where_the_crops_intrinsics_say():
    """Cropping and sampling agree to a fraction of a pixel, so both follow one convention."""
    u, v = torch.meshgrid(torch.arange(640.0), torch.arange(480.0), indexing="xy")
    ramps = torch.stack([u, v])[None].double()
    box = torch.tensor([[100.3, 80.1, 260.3, 200.1]]).double()
    crop = sample_boxes(ramps, box, torch.tensor([0]), SIZE)[0]
    camera = crop_intrinsics(K, box, SIZE)[0]
    for row, column in ((0, 0), (17, 200), (239, 319)):
        ray = torch.linalg.solve(K, torch.tensor([*crop[:, row, column], 1.0]).double())
        torch.testing.assert_close(
            (camera @ ray)[:2], torch.tensor([column, row]).double(), rtol=0, atol=1e-9
        )


def test_views_against_the_slow_ones():
    T = poses(20, seed=2)
    views = front_views(T)
    for i in range(len(T)):
        np.testing.assert_allclose(views[i], np.stack(slow.four_views(T[i].tolist())), rtol=0, atol=1e-12)
    # All look at the origin but the first, the last two from sqrt(2) times as far.
    distance = torch.linalg.vector_norm(T[:, :3, 3], dim=-1)
    torch.testing.assert_close(views[:, 1:, :2, 3], torch.zeros(20, 3, 2).double(), rtol=0, atol=1e-12)
    for view, factor in ((1, 1.0), (2, 2**0.5), (3, 2**0.5)):
        torch.testing.assert_close(views[:, view, 2, 3], factor * distance)


def test_update_against_the_slow_one():
    T = poses(20, seed=3)
    cameras = crop_intrinsics(K, crop_boxes(points(), T, K, SIZE, near=0.1), SIZE)
    numbers = torch.from_numpy(np.random.default_rng(4).normal(size=(20, 9)))
    numbers[:, 8] = 1.0 + 0.1 * numbers[:, 8]
    moved = apply_update(
        T, torch.cat([numbers[:, 6:], numbers[:, :6]], 1), cameras, torch.zeros(20, 3).double()
    )
    for i in range(len(T)):
        expected = slow.updated(T[i].tolist(), cameras[i].tolist(), numbers[i].tolist())
        np.testing.assert_allclose(moved[i], expected, rtol=0, atol=1e-12)


def test_gradients_of_an_update():
    T, camera = (
        poses(2, seed=5),
        crop_intrinsics(K, crop_boxes(points(), poses(2, seed=5), K, SIZE, 0.1), SIZE),
    )
    update = torch.tensor([[3.0, -2.0, 1.1, 0.9, 0.2, -0.1, -0.3, 1.2, 0.4]]).double().repeat(2, 1)
    inputs = [x.requires_grad_() for x in (T, update, camera, torch.zeros(2, 3).double())]
    assert torch.autograd.gradcheck(apply_update, inputs)


@pytest.mark.parametrize(
    "box",
    [
        (2.3, 1.2, 14.8, 9.9),  # inside
        (-4.0, -3.5, 12.0, 8.5),  # over the border
        (10.0, 6.0, 30.0, 21.0),  # over the other
        (5.0, 5.0, 5.4, 5.3),  # smaller than a pixel counts as one
    ],
)
def test_sampling_against_a_brute_force_average(box):
    images = torch.from_numpy(np.random.default_rng(0).random((2, 3, 13, 17)))
    crops = sample_boxes(images, torch.tensor([box, box], dtype=torch.float64), torch.tensor([1, 0]), (6, 8))
    for crop, image in zip(crops, images.flip(0), strict=True):
        for channel in range(3):
            expected = slow.roi_align(image[channel].tolist(), box, 6, 8)
            np.testing.assert_allclose(crop[channel], expected, rtol=0, atol=1e-12)


def test_gradients_of_sampling():
    images = torch.from_numpy(np.random.default_rng(1).random((1, 2, 7, 9))).requires_grad_()
    boxes = torch.tensor([[1.17, 1.31, 6.93, 5.71]]).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, y: sample_boxes(x, y, torch.tensor([0]), (3, 4)), (images, boxes), eps=1e-7, atol=1e-4
    )


def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5)
    vertices = torch.from_numpy(mesh.vertices).float()
    return Mesh(vertices, torch.from_numpy(mesh.faces), vertex_normals=vertices)


def test_a_spheres_normals_as_colours():
    """Right, away and up are red, green and blue, and negative ones come out one larger."""
    T = torch.eye(4)[None]
    T[:, 2, 3] = 100.0
    out = RaycastRenderer(1, 1.0)(
        sphere(), T, intrinsics_matrix(5000.0, 5000.0, 60.0, 60.0)[None], (121, 121)
    )
    colors = normal_colors(out.normals, out.mask)[0]
    assert (colors[:, ~out.mask[0]] == 0).all()
    half_texel = 0.5 / 32
    for right, up in ((0.4, 0.3), (-0.4, 0.3), (0.4, -0.3), (-0.4, -0.3)):
        away = -((1.0 - right**2 - up**2) ** 0.5)
        column, row = round(60 + 50 * right), round(60 - 50 * up)
        expected = torch.tensor([right, away, up]) % 1.0 - half_texel
        torch.testing.assert_close(colors[:, row, column], expected, rtol=0, atol=0.012)
    # Where a component is zero the texture's ends meet: half of its last colour.
    torch.testing.assert_close(colors[:, 60, 60], torch.full((3,), 247 / 510), rtol=0, atol=0.02)


def test_texels_are_the_releases():
    """A brute-force lookup in the texture: colour of texel (i, j, k) is (i, j, k) · 255 / 32, rounded down."""
    normals = torch.nn.functional.normalize(
        torch.from_numpy(np.random.default_rng(2).normal(size=(200, 3))), dim=1
    )
    colors = normal_colors(normals.T[:, None], torch.ones(1, 200, dtype=torch.bool))[:, 0].T
    for (x, y, z), color in zip(normals.tolist(), colors.tolist(), strict=True):
        for component, value in zip((x, z, -y), color, strict=True):
            place = component * 32 - 0.5
            low = int(np.floor(place))
            texel = [int((i % 32) * 255 / 32) / 255 for i in (low, low + 1)]
            assert value == pytest.approx(texel[0] + (place - low) * (texel[1] - texel[0]), abs=1e-9)


def test_ambient_light_alone_shows_the_texture():
    """Each face of a cube has a colour of its own in the texture; the picture has these values."""
    box = trimesh.creation.box()
    corners = torch.from_numpy(box.vertices).float()[torch.from_numpy(box.faces)].reshape(-1, 3)
    faces = torch.arange(len(corners)).reshape(-1, 3)
    normal = torch.from_numpy(np.array(box.face_normals)).float()
    side = (normal.abs().argmax(1) * 2 + (normal.sum(1) > 0)).repeat_interleave(3)
    palette = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    texture = palette.repeat_interleave(16, 0).T[:, None].expand(3, 16, 96)
    uv = torch.stack([(side + 0.5) / 6, torch.full((len(side),), 0.5)], dim=1)
    mesh = Mesh(corners, faces, uv=uv, texture=texture)
    T = make_transform(
        torch.from_numpy(Rotation.from_euler("xyz", [35, 25, 0], degrees=True).as_matrix()).float(),
        torch.tensor([0.0, 0.0, 5.0]),
    )[None]
    out = RaycastRenderer(1, 1.0)(mesh, T, intrinsics_matrix(200.0, 200.0, 60.0, 60.0)[None], (121, 121))
    seen = out.rgb[0][:, out.mask[0]].T
    distance = (seen[:, None] - palette).abs().amax(-1)
    assert (distance.amin(1) < 1e-5).all()
    assert len(distance.argmin(1).unique()) == 3

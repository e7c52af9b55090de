from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from foundpose.geometry import (
    PerspectiveCrop,
    intrinsics_matrix,
    invert_transform,
    make_transform,
    pixel_rays,
    project_points,
    rotation_angle,
    transform_points,
)
from foundpose.geometry.circles import Circles
from foundpose.pnp import PnpStatus, TopTemplatePose
from foundpose.pnp.template_pose import (
    align_bounding_circles,
    mask_circles,
    outline_points,
    rotation_between,
)
from foundpose.rendering import CoordinateRenderer

SIZE = (480, 640)
K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)


class Query(NamedTuple):
    """Pictures of templates' views: other distance, off-axis."""

    crops: object
    T_camera_from_model: Tensor
    template: Tensor


def turn_axis_to(rays):
    """Rotations without roll that bring the optical axis onto rays (N, 3), by scipy."""
    rays = rays.double() / rays.double().norm(dim=1, keepdim=True)
    axis = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(rays), rays)
    angle = torch.acos(rays[:, 2:])
    rotvec = axis / axis.norm(dim=1, keepdim=True) * angle
    return torch.from_numpy(Rotation.from_rotvec(rotvec.numpy()).as_matrix()).float()


@pytest.fixture(scope="module")
def query(blob, oracle_blob):
    g = torch.Generator().manual_seed(0)
    template = torch.randint(oracle_blob.num_templates, (12,), generator=g)
    pixels = torch.tensor([150.0, 120.0]) + torch.rand(12, 2, generator=g) * torch.tensor([340.0, 240.0])
    distance = (3.5 + 5 * torch.rand(12, generator=g)) * blob.diameter
    T = oracle_blob.T_template_from_model[template].clone()
    centre = centres(T, blob)
    T[:, :3, 3] += centre * (distance / centre.norm(dim=1) - 1)[:, None]
    R = turn_axis_to(pixel_rays(pixels, K))
    T = make_transform(R, torch.zeros(12, 3)) @ T
    masks = CoordinateRenderer()(blob, T, K.expand(12, 3, 3), SIZE).mask
    crops = PerspectiveCrop()(torch.zeros(1, 3, *SIZE), K[None], masks, image_index=torch.zeros(12).long())
    return Query(crops, T, template)


def centres(T, mesh):
    return transform_points(T, mesh.bounds.mean(0).float()[None])[:, 0]


def test_a_view_of_a_template_from_elsewhere_gives_its_pose(blob, oracle_blob, query):
    result = TopTemplatePose()(query.crops.masks, query.crops.K_crop, query.template[:, None], oracle_blob)
    assert result.success.all()
    assert (result.status == PnpStatus.OK).all()
    T = invert_transform(query.crops.T_crop_from_camera) @ result.T_crop_from_model[:, 0]
    angle = torch.rad2deg(rotation_angle(T[:, :3, :3], query.T_camera_from_model[:, :3, :3]))
    ours, truth = centres(T, blob), centres(query.T_camera_from_model, blob)
    shift = (project_points(ours, K)[0] - project_points(truth, K)[0]).norm(dim=1)
    depth = ours[:, 2] / truth[:, 2] - 1
    assert angle.max() < 0.5
    assert shift.median() < 1.0
    assert shift.max() < 2.5
    assert depth.abs().max() < 0.015
    # The masks' pixels are a little wider than the object; there is no other bias.
    assert depth.mean().abs() < 0.006


def test_the_circles_are_aligned(blob, oracle_blob, query):
    """OpenCV's circles around the mask and around the mesh at the pose are the same."""
    index = query.template[:, None].repeat(1, 3)
    index[:, 1:] = torch.tensor([5, 60])
    result = TopTemplatePose()(query.crops.masks, query.crops.K_crop, index, oracle_blob)
    assert result.success.all()
    for i in range(12):
        inside = np.argwhere(query.crops.masks[i].numpy() > 0.5)[:, ::-1].astype(np.float32)
        centre, radius = cv2.minEnclosingCircle(np.ascontiguousarray(inside))
        for T in result.T_crop_from_model[i]:
            points = transform_points(T, blob.hull_vertices.float())
            pixels, _ = project_points(points, query.crops.K_crop[i])
            seen_centre, seen_radius = cv2.minEnclosingCircle(np.ascontiguousarray(pixels))
            # The points of the templates' patches stand for the mesh. Where two points all but determine a circle,
            # its centre hangs on a third.
            assert abs(radius - seen_radius) < 0.6
            assert np.hypot(*np.subtract(centre, seen_centre)) < 6.0


def test_apparent_orientation_is_kept(oracle_blob, query):
    """The object is turned with its viewing ray, so the template's view stays what is seen."""
    T_template = oracle_blob.T_template_from_model[query.template]
    result = TopTemplatePose()(query.crops.masks, query.crops.K_crop, query.template[:, None], oracle_blob)
    # The crop's camera looks at the object, as the template's does.
    R = result.T_crop_from_model[:, 0, :3, :3]
    assert torch.rad2deg(rotation_angle(R, T_template[:, :3, :3])).max() < 1.5


def test_batch_independence(oracle_blob, query):
    index = torch.stack([query.template, query.template.flip(0)], dim=1)
    together = TopTemplatePose()(query.crops.masks, query.crops.K_crop, index, oracle_blob)
    for i in (0, 7):
        row = slice(i, i + 1)
        alone = TopTemplatePose()(query.crops.masks[row], query.crops.K_crop[row], index[row], oracle_blob)
        torch.testing.assert_close(alone.T_crop_from_model[0], together.T_crop_from_model[i])


def test_masks_that_give_no_circle_are_flagged(oracle_blob, query):
    masks = query.crops.masks[:3].clone()
    masks[0] = 0.0
    masks[1] = 0.0
    masks[1, 100, 100] = 1.0
    index = query.template[:3, None]
    result = TopTemplatePose()(masks, query.crops.K_crop[:3], index, oracle_blob)
    assert result.status[:, 0].tolist() == [PnpStatus.DEGENERATE, PnpStatus.DEGENERATE, PnpStatus.OK]
    assert torch.isfinite(result.T_crop_from_model).all()
    assert torch.equal(result.T_crop_from_model[:2, 0], oracle_blob.T_template_from_model[index[:2, 0]])


def test_a_circle_wider_than_the_view_is_flagged(oracle_blob):
    wide = intrinsics_matrix(40.0, 40.0, 210.0, 210.0)[None]
    result = TopTemplatePose()(torch.ones(1, 420, 420), wide, torch.tensor([[0, 1]]), oracle_blob)
    assert not result.success.any()
    assert torch.isfinite(result.T_crop_from_model).all()


def test_mask_circles_equal_opencv(rng):
    masks = torch.zeros(5, 60, 60)
    for i in range(4):
        polygon = rng.integers(5, 55, (5, 2)).astype(np.int32)
        masks[i] = torch.from_numpy(cv2.fillPoly(np.zeros((60, 60), np.float32), [polygon], 1.0))
    circles = mask_circles(masks, torch.float32)
    assert circles.valid.tolist() == [True] * 4 + [False]
    for i in range(4):
        inside = np.ascontiguousarray(np.argwhere(masks[i].numpy())[:, ::-1].astype(np.float32))
        centre, radius = cv2.minEnclosingCircle(inside)
        np.testing.assert_allclose(circles.centre[i], centre, atol=1e-3)
        np.testing.assert_allclose(circles.radius[i], radius, atol=1e-3)


def test_outline_points_stand_for_all_points(oracle_blob, blob):
    """In every direction, they reach as far as the patches of all templates do, and as far as the mesh."""
    outline = outline_points(oracle_blob)
    assert outline.shape == (8 * oracle_blob.num_templates, 3)
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    reach = (outline @ directions.T).amax(0)
    pixel = blob.diameter / 252  # of a template
    lost = (oracle_blob.points_model @ directions.T).amax(0) - reach
    assert lost.min() >= 0
    assert lost.mean() < 0.5 * pixel
    assert lost.max() < 3 * pixel
    assert ((blob.hull_vertices.float() @ directions.T).amax(0) - reach).mean() < pixel


class Views(NamedTuple):
    points_model: Tensor
    template_offsets: Tensor
    max_patches: int
    T_template_from_model: Tensor


def test_templates_without_patches():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    offsets = torch.tensor([0, 0, 2, 3, 3])
    outline = outline_points(Views(points, offsets, 2, torch.eye(4).expand(4, 4, 4)))
    assert {tuple(p) for p in outline.tolist()} == {tuple(p) for p in points.tolist()}


def test_gradients():
    g = torch.Generator().manual_seed(3)
    points = torch.randn(10, 3, generator=g, dtype=torch.float64)
    T = make_transform(
        torch.from_numpy(Rotation.random(2, random_state=0).as_matrix()).reshape(1, 2, 3, 3),
        torch.tensor([0.3, -0.2, 12.0], dtype=torch.float64).expand(1, 2, 3),
    )
    camera = intrinsics_matrix(500.0, 500.0, 209.5, 209.5).double()[None]
    circle = torch.tensor([[230.0, 190.0]]).double(), torch.tensor([110.0]).double()

    def align(T, points, centre, radius, camera):
        target = Circles(centre, radius, torch.ones(1, dtype=torch.bool))
        result = align_bounding_circles(T, points, target, camera)
        assert result.success.all()
        return result.T_crop_from_model

    inputs = [x.requires_grad_() for x in (T, points, *circle, camera)]
    assert torch.autograd.gradcheck(align, inputs, atol=1e-4)


def test_rotation_between_equals_scipy(generator):
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=generator).double(), dim=-1)
    R = rotation_between(a, b)
    torch.testing.assert_close((R @ a[..., None])[..., 0], b)
    angle = torch.acos((a * b).sum(-1))
    axis = torch.nn.functional.normalize(torch.linalg.cross(a, b), dim=-1)
    reference = Rotation.from_rotvec((axis * angle[:, None]).numpy()).as_matrix()
    np.testing.assert_allclose(R, reference, atol=1e-9)


def test_bad_input(oracle_blob):
    with pytest.raises(ValueError, match=r"\(B, S, S\) and \(B, 3, 3\), got \(2, 8, 8\) and \(1, 3, 3\)"):
        TopTemplatePose()(torch.ones(2, 8, 8), K[None], torch.zeros(2, 1).long(), oracle_blob)
    with pytest.raises(ValueError, match=r"template_index must have shape \(1, h\), got \(2, 1\)"):
        TopTemplatePose()(torch.ones(1, 8, 8), K[None], torch.zeros(2, 1).long(), oracle_blob)

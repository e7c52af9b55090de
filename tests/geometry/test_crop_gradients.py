"""Gradients of crops and of the geometry under them."""

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from foundpose.geometry import (
    PerspectiveCrop,
    axis_rotation_to_ray,
    camera_on_boxes,
    intrinsics_matrix,
    invert_transform,
    pixel_rays,
    project_points,
    project_to_rotation,
    resize_intrinsics,
    rotation_angle,
    se3_exp,
    shift_intrinsics,
    transform_points,
    unproject_pixels,
)
from foundpose.geometry.crop import Crops
from foundpose.geometry.warp import warp_images


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pictures(count: int, height: int = 16, width: int = 18) -> Tensor:
    g = torch.Generator().manual_seed(0)
    return torch.rand(count, 3, height, width, generator=g, dtype=torch.float64).requires_grad_()


def cameras(count: int) -> Tensor:
    return intrinsics_matrix(20.0, 21.0, 8.3, 7.4).double().repeat(count, 1, 1).requires_grad_()


def with_bottom_row(top: Tensor) -> Tensor:
    """Intrinsics from their first two rows: perturbing the last one gives no camera."""
    return torch.cat([top, top.new_tensor([[[0.0, 0.0, 1.0]]]).expand(len(top), 1, 3)], dim=1)


# Two crops of image 0, the first three times and the second about 1.4 times smaller; one of image 1, enlarged.
BOXES = torch.tensor(
    [[1.1, 2.2, 14.3, 13.1], [4.2, 3.3, 10.4, 9.2], [6.1, 5.2, 8.6, 7.3]], dtype=torch.float64
)
INDEX = torch.tensor([0, 0, 1])
CROP = PerspectiveCrop(size=7)


def test_antialiased_crops_have_the_gradients_of_finite_differences() -> None:
    images, tops, boxes = (
        pictures(2),
        cameras(2).detach()[:, :2].requires_grad_(),
        BOXES.clone().requires_grad_(),
    )

    def crop(i: Tensor, k: Tensor, b: Tensor) -> Tensor:
        return CROP(i, with_bottom_row(k), boxes=b, image_index=INDEX).images

    # 1e-7: sample positions stay between the same pixels.
    assert gradcheck(lambda k, b: crop(images.detach(), k, b), (tops, boxes), eps=1e-7, atol=1e-6)
    assert gradcheck(crop, (images, tops, boxes), eps=1e-7, atol=1e-6, fast_mode=True)


def test_soft_masks_are_differentiable_through_the_warp() -> None:
    masks = torch.rand(2, 1, 9, 11, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    homographies = 0.4 * torch.eye(3, dtype=torch.float64).repeat(3, 1, 1) + 0.01 * randn(3, 3, 3)
    homographies = torch.cat([homographies[:, :2], homographies.new_tensor([[[0, 0, 1]]]).expand(3, 1, 3)], 1)
    levels = torch.tensor([0.3, 1.6, 0.0], dtype=torch.float64)
    inputs = [t.requires_grad_() for t in (masks, homographies, levels[:2].clone())]
    assert gradcheck(
        lambda m, h, s: warp_images(m, h, INDEX, torch.cat([s, levels[2:]]), 5), inputs, eps=1e-7, atol=1e-6
    )


def total(crops: Crops) -> Tensor:
    """A loss on everything that a crop has, valid or not."""
    cameras_and_boxes = (
        crops.K_crop.sin().sum() + crops.T_crop_from_camera.sin().sum() + crops.boxes.sin().sum()
    )
    return crops.images.sin().sum() + crops.masks.sum() + cameras_and_boxes


def test_samples_that_are_not_valid_have_zero_gradients() -> None:
    nan, inf = torch.nan, torch.inf
    good = [3.0, 4.0, 12.0, 11.0]
    boxes = [
        good,
        [12.0, 4.0, 3.0, 11.0],
        [nan, 4.0, 12.0, 11.0],
        [30.0, 4.0, 40.0, 11.0],
        [3.0, 4.0, 4.0, 5.0],
    ]
    box = torch.tensor(
        [*boxes, [3.0, 4.0, inf, 11.0], good, good, good], dtype=torch.float64, requires_grad=True
    )
    K = cameras(9).detach()
    K[6, 0, 0], K[7], K[8, 1, 1] = nan, 0.0, -20.0
    K.requires_grad_()
    images = pictures(9)
    crops = CROP(images, K, boxes=box)
    assert crops.valid.tolist() == [True] + 8 * [False]
    # Each of them shows the whole image.
    whole = torch.tensor([-0.5, -0.5, 17.5, 15.5], dtype=torch.float64)
    assert torch.equal(crops.boxes[1:], whole.expand(8, 4))
    assert all(torch.isfinite(t).all() for t in crops)
    for gradient in torch.autograd.grad(total(crops), (images, K, box)):
        assert torch.isfinite(gradient).all()
        assert gradient[0].abs().max() > 0
        assert (gradient[1:] == 0).all()


def test_masks_and_boxes_of_masks_are_constants() -> None:
    masks = torch.zeros(2, 16, 18, dtype=torch.float64)
    masks[0, 4:9, 5:12] = 0.7
    masks.requires_grad_()
    images, K = pictures(2), cameras(2)
    crops = CROP(images, K, masks)
    assert crops.valid.tolist() == [True, False]
    assert not crops.masks.requires_grad
    assert not crops.boxes.requires_grad
    for gradient in torch.autograd.grad(total(crops), (images, K)):
        assert gradient[0].abs().max() > 0
        assert (gradient[1] == 0).all()


@pytest.mark.parametrize("antialias", [True, False])
def test_gradients_do_not_depend_on_neighbours(antialias: bool) -> None:
    module = PerspectiveCrop(size=7, antialias=antialias)
    images, K, boxes = pictures(2), cameras(2), BOXES.clone().requires_grad_()
    together = torch.autograd.grad(
        total(module(images, K, boxes=boxes, image_index=INDEX)), (images, K, boxes)
    )
    sums = [torch.zeros_like(t) for t in together]
    for b, n in enumerate(INDEX.tolist()):
        one = [
            t.detach().clone().requires_grad_() for t in (images[n : n + 1], K[n : n + 1], boxes[b : b + 1])
        ]
        alone = torch.autograd.grad(total(module(one[0], one[1], boxes=one[2])), one)
        for s, gradient, slot in zip(sums, alone, (n, n, b), strict=True):
            s[slot] += gradient[0]
    for s, gradient in zip(sums, together, strict=True):
        torch.testing.assert_close(s, gradient, rtol=1e-10, atol=1e-12)


def test_cameras_on_boxes_where_corners_and_sides_tie() -> None:
    # A square box around the principal point: each of its sides is spanned by two corners at once.
    K = intrinsics_matrix(20.0, 20.0, 8.0, 7.0).double()[None]
    boxes = torch.tensor(
        [[3.0, 2.0, 13.0, 12.0], [3.0, 4.0, 13.0, 10.0]], dtype=torch.float64, requires_grad=True
    )
    square, wide = torch.autograd.grad(camera_on_boxes(boxes, K, 10, 0.6)[0][:, 0, 0].sum(), boxes)[0]
    # f' = fill S f / width and, where width and height tie, half of either's gradient.
    slope = 0.6 * 10 * 20.0 / 10.0**2
    torch.testing.assert_close(wide, slope * torch.tensor([1.0, 0.0, -1.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(square, 0.5 * slope * torch.tensor([1, 1, -1, -1], dtype=torch.float64))


@pytest.mark.parametrize(
    "angle", [0.0, 1e-8, 1e-3, 1.0, math.pi - 1e-6, math.pi, 2 * math.pi - 1e-7, 2 * math.pi]
)
def test_exponential_map_in_reverse_and_forward_mode(angle: float) -> None:
    axis = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    twist = torch.cat([randn(3), angle * axis])[None].requires_grad_()
    assert gradcheck(se3_exp, (twist,), check_forward_ad=True)
    single = twist.detach()[0].float()
    jacobian = torch.func.jacfwd(se3_exp)(single)
    torch.testing.assert_close(jacobian, torch.func.jacrev(se3_exp)(single), rtol=1e-4, atol=1e-6)
    assert jacobian.abs().max() > 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_angle_has_unit_slope_and_finite_subgradients_at_its_kinks(dtype: torch.dtype) -> None:
    base = se3_exp(randn(5, 6))[:, :3, :3].to(dtype)
    axis = torch.nn.functional.normalize(randn(5, 3, seed=1), dim=-1)
    for angle in (0.0, 1e-4, 1.0, 3.0, math.pi):
        twist = torch.cat([torch.zeros(5, 3).double(), angle * axis], dim=-1).to(dtype).requires_grad_()
        distance = rotation_angle(base, base @ se3_exp(twist)[:, :3, :3])
        (gradient,) = torch.autograd.grad(distance.sum(), twist)
        slope = (gradient[:, 3:] * axis.to(dtype)).sum(-1)
        assert torch.isfinite(gradient).all()
        if 0.0 < angle < math.pi:
            torch.testing.assert_close(slope, torch.ones_like(slope), rtol=1e-2, atol=0)
        else:
            assert (gradient[:, 3:].norm(dim=-1) <= 1.0 + 1e-3).all()
    # Both arguments the same, and half a turn without rounding: exactly on the kinks.
    for R in (torch.eye(3, dtype=dtype), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=dtype))):
        a, b = torch.eye(3, dtype=dtype, requires_grad=True), R.clone().requires_grad_()
        for gradient in torch.autograd.grad(rotation_angle(a, b), (a, b)):
            assert (gradient == 0).all()


def test_angle_gradcheck() -> None:
    R_a, R_b = (se3_exp(randn(4, 6, seed=s))[:, :3, :3].requires_grad_() for s in (2, 3))
    assert gradcheck(rotation_angle, (R_a, R_b))


def test_nearest_rotation_is_differentiable_at_rotations_and_beyond() -> None:
    R = se3_exp(randn(3, 6))[:, :3, :3]
    flat = R @ torch.diag(torch.tensor([2.0, 1.0, 0.0], dtype=torch.float64))  # coplanar points
    mirrored = R @ torch.diag(torch.tensor([2.0, 1.0, -0.3], dtype=torch.float64))
    for M in (R, 3.0 * R, randn(6, 3, 3, seed=4), flat, mirrored):
        assert gradcheck(project_to_rotation, (M.clone().requires_grad_(),))
    assert torch.equal(project_to_rotation(M), project_to_rotation(M.requires_grad_()).detach())
    # Nothing is determined by a zero matrix, one direction by a line; a mirrored rotation may turn about any axis.
    line = R @ torch.diag(torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))
    for M in (torch.zeros(1, 3, 3), line, line.float(), -R, -R.float()):
        M = M.clone().requires_grad_()
        rotation = project_to_rotation(M)
        (gradient,) = torch.autograd.grad(rotation.sin().sum(), M)
        assert torch.isfinite(gradient).all()
        assert gradient.abs().max() < 10
        assert torch.allclose(torch.det(rotation), torch.ones(len(M), dtype=M.dtype))


def test_points_and_cameras_gradcheck() -> None:
    K = cameras(2)
    points = (randn(2, 4, 3) + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)).detach()
    points[1, 0, 2] = -2.0
    pixels, depth = 9 + 3 * randn(2, 4, 2), 3 + randn(2, 4).abs()
    for inputs, function in (
        ((points, K), project_points),
        ((pixels, K), pixel_rays),
        ((pixels, depth, K), unproject_pixels),
        ((K, pixels[:, 0]), shift_intrinsics),
        ((K,), lambda k: resize_intrinsics(k, 0.3)),
        ((torch.cat([points[0], points.new_tensor([[0.0, 0.0, 2.0]])]),), axis_rotation_to_ray),
        ((se3_exp(randn(2, 6)), points), transform_points),
        ((se3_exp(randn(2, 6)),), invert_transform),
    ):
        assert gradcheck(function, tuple(t.detach().clone().requires_grad_() for t in inputs))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_in_the_plane_of_the_camera_have_finite_gradients(dtype: torch.dtype) -> None:
    points = torch.tensor(
        [[[1.0, 2.0, 0.0], [1.0, 2.0, 1e-12], [0.0, 0.0, 0.0]]], dtype=dtype, requires_grad=True
    )
    K = cameras(1).detach().to(dtype).requires_grad_()
    pixels, _ = project_points(points, K)
    for gradient in torch.autograd.grad(pixels.sum(), (points, K)):
        assert torch.isfinite(gradient).all()

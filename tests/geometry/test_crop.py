import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.transform import warp_perspective

from foundpose.geometry import (
    PerspectiveCrop,
    boxes_from_masks,
    boxes_from_xywh,
    camera_on_boxes,
    intrinsics_matrix,
    masks_from_boxes,
    project_points,
    resize_intrinsics,
    shift_intrinsics,
    transform_points,
)
from foundpose.geometry.warp import warp_images


def camera(dtype=torch.float64):
    return intrinsics_matrix(572.4, 573.6, 325.3, 242.0).to(dtype)


def disc_mask(height, width, u, v, radius):
    ys, xs = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (xs - u) ** 2 + (ys - v) ** 2 <= radius**2


def ramp_image(height, width, dtype):
    """Channels u, v and 1: a warp must return source coordinates exactly, since bilinear sampling is linear."""
    v, u = torch.meshgrid(torch.arange(height, dtype=dtype), torch.arange(width, dtype=dtype), indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)])[None]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-4), (torch.float32, 1e-2)])
def test_projection_agrees_with_the_warp(dtype, tolerance):
    K = camera(dtype)
    image = ramp_image(480, 640, dtype)
    boxes = boxes_from_xywh(torch.tensor([[500.0, 50.0, 90.0, 60.0], [20.0, 380.0, 40.0, 80.0]], dtype=dtype))
    # Without antialiasing the ramp is sampled exactly, so the crop holds source coordinates.
    crops = PerspectiveCrop(antialias=False)(image, K[None], boxes=boxes, image_index=torch.tensor([0, 0]))
    gen = torch.Generator().manual_seed(0)
    for b in range(2):
        lo, hi = boxes[b, :2], boxes[b, 2:]
        pixels = lo + (hi - lo) * torch.rand(200, 2, generator=gen, dtype=dtype)
        depth = 500 + 500 * torch.rand(200, generator=gen, dtype=dtype)
        rays = torch.cat([pixels, torch.ones(200, 1, dtype=dtype)], 1) @ torch.linalg.inv(K).T
        points = rays * depth[:, None]
        in_crop, _ = project_points(transform_points(crops.T_crop_from_camera[b], points), crops.K_crop[b])
        sampled = torch.nn.functional.grid_sample(
            crops.images[b : b + 1].double(),
            ((2 * in_crop.double() + 1) / 420 - 1)[None, None],
            align_corners=False,
        )[0, :2, 0].T
        # Bilinear interpolation of a projective map errs by the map's curvature only (< 1e-5 px here).
        assert (sampled - pixels).abs().max() < tolerance


def test_identity_warp_of_a_ramp_and_integer_shift():
    image = ramp_image(64, 64, torch.float64)
    eye = torch.eye(3, dtype=torch.float64)[None]
    zero = torch.zeros(1, dtype=torch.int64)
    out = warp_images(image, eye, zero, torch.zeros(1, dtype=torch.float64), 64)
    assert torch.allclose(out, image, atol=1e-9)
    shift = eye.clone()
    shift[0, :2, 2] = torch.tensor([-5.0, -3.0], dtype=torch.float64)
    moved = warp_images(image, shift, zero, torch.zeros(1, dtype=torch.float64), 32)
    assert torch.allclose(moved, image[..., 3:35, 5:37], atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_warp_equals_kornias(dtype):
    generator = torch.Generator().manual_seed(4)
    images = torch.rand(3, 3, 90, 121, generator=generator).to(dtype)
    eye = torch.eye(3).repeat(3, 1, 1)
    H = (eye + torch.randn(3, 3, 3, generator=generator) * torch.tensor([[0.2], [0.2], [5e-4]])).to(dtype)
    H[:, :2, 2] += torch.tensor([-20.0, -12.0], dtype=dtype)
    ours = warp_images(images, H, torch.arange(3), torch.zeros(3, dtype=dtype), 70)
    theirs = warp_perspective(images, H, (70, 70), align_corners=True)
    assert (ours - theirs).abs().max() < (2e-4 if dtype == torch.float32 else 1e-10)
    assert (ours > 0).double().mean() > 0.5


def test_intrinsics_of_shift_and_resize():
    K = camera()
    point = torch.tensor([[30.0, -20.0, 700.0]], dtype=torch.float64)
    uv, _ = project_points(point, K)
    shifted, _ = project_points(point, shift_intrinsics(K, torch.tensor([7.0, 9.0])))
    assert torch.allclose(shifted, uv - torch.tensor([7.0, 9.0]))
    resized, _ = project_points(point, resize_intrinsics(K, 0.5))
    assert torch.allclose(resized, (uv + 0.5) * 0.5 - 0.5)


def test_axis_through_the_box_centre_and_longer_side_is_fill(generator):
    K = camera()
    low = torch.rand(50, 2, generator=generator, dtype=torch.float64) * torch.tensor([600.0, 440.0])
    extent = 10 + torch.rand(50, 2, generator=generator, dtype=torch.float64) * 200
    boxes = torch.cat([low, low + extent], dim=1)
    K_crop, T = camera_on_boxes(boxes, K.expand(50, 3, 3), 420, 0.6)

    def warp(pixels):
        rays = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ torch.linalg.inv(K).T
        return project_points(transform_points(T, rays), K_crop)[0]

    centre = warp((boxes[:, None, :2] + boxes[:, None, 2:]) / 2)
    assert torch.allclose(centre, torch.full_like(centre, 209.5), atol=1e-8)
    corners = torch.stack([boxes[:, [0, 1]], boxes[:, [2, 1]], boxes[:, [0, 3]], boxes[:, [2, 3]]], 1)
    warped = warp(corners)
    side = (warped.amax(1) - warped.amin(1)).amax(1)
    assert torch.allclose(side, torch.full_like(side, 252.0), atol=1e-8)
    # Smallest rotation: its axis has no z component.
    R = T[:, :3, :3]
    assert (R[:, 1, 0] - R[:, 0, 1]).abs().max() < 1e-12
    assert torch.allclose(torch.det(R), torch.ones(50, dtype=torch.float64))


def test_warp_equals_opencv(rng):
    image = cv2.GaussianBlur(rng.random((480, 640, 3)), (0, 0), 2)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None]
    K = camera()
    crop = PerspectiveCrop(antialias=False)(
        tensor, K[None], boxes=torch.tensor([[100.0, 80.0, 190.0, 200.0]], dtype=torch.float64)
    )
    H = crop.K_crop[0] @ crop.T_crop_from_camera[0, :3, :3] @ torch.linalg.inv(K)
    grid = cv2.perspectiveTransform(
        np.stack(np.meshgrid(np.arange(420.0), np.arange(420.0)), -1), np.linalg.inv(H.numpy())
    ).astype(np.float32)
    expected = cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
    # OpenCV rounds the bilinear weights to 1/32 px.
    assert np.abs(crop.images[0].permute(1, 2, 0).numpy() - expected).max() < 5e-3


def test_boxes_of_masks_span_pixel_edges():
    masks = torch.zeros(3, 20, 30, dtype=torch.bool)
    masks[0, 4:9, 7:8] = True
    masks[1, 0, 29] = True
    boxes, valid = boxes_from_masks(masks)
    assert boxes[0].tolist() == [6.5, 3.5, 7.5, 8.5]
    assert boxes[1].tolist() == [28.5, -0.5, 29.5, 0.5]
    assert valid.tolist() == [True, True, False]
    assert torch.equal(masks_from_boxes(boxes[:2], 20, 30), masks[:2])


def test_unusable_masks_are_flagged_and_leave_their_neighbours_alone():
    image = torch.rand(1, 3, 120, 160, generator=torch.Generator().manual_seed(1))
    K = intrinsics_matrix(200.0, 200.0, 79.5, 59.5)[None]
    masks = torch.zeros(4, 120, 160, dtype=torch.bool)
    masks[1, 50, 60] = True
    masks[2] = disc_mask(120, 160, 100, 60, 15)
    masks[3, :, :] = True
    module = PerspectiveCrop(size=84)
    crops = module(image, K, masks, image_index=torch.zeros(4, dtype=torch.int64))
    assert crops.valid.tolist() == [False, False, True, True]
    assert all(torch.isfinite(t).all() for t in crops)
    assert crops.masks[:2].abs().max() == 0
    alone = module(image, K, masks[2:3])
    for name in ("images", "masks", "K_crop", "T_crop_from_camera"):
        assert torch.equal(getattr(crops, name)[2], getattr(alone, name)[0]), name
    nan = float("nan")
    boxes = torch.tensor([[500.0, 10, 600, 60], [nan, 0, 10, 10], [30, 30, 20, 60], [10, 10, 60, 60]])
    crops = module(image, K, boxes=boxes, image_index=torch.zeros(4, dtype=torch.int64))
    assert crops.valid.tolist() == [False, False, False, True]
    assert all(torch.isfinite(t).all() for t in crops)


def test_box_crop_mask_is_the_box():
    image = torch.rand(1, 3, 120, 160)
    K = intrinsics_matrix(200.0, 200.0, 79.5, 59.5)[None]
    crops = PerspectiveCrop(size=100, fill=0.6)(image, K, boxes=torch.tensor([[49.5, 39.5, 109.5, 79.5]]))
    share = crops.masks[0].mean().item()
    assert share == pytest.approx(0.6 * 0.6 * 40 / 60, rel=0.02)


def test_several_images_in_one_batch_equal_each_alone():
    gen = torch.Generator().manual_seed(3)
    images = torch.rand(3, 3, 100, 140, generator=gen)
    K = torch.stack([intrinsics_matrix(150.0 + 10 * i, 155.0, 70.0, 50.0 - i) for i in range(3)])
    masks = torch.stack([disc_mask(100, 140, 40 + 15 * i, 50, 8 + 6 * i) for i in range(5)])
    index = torch.tensor([2, 0, 2, 1, 0])
    module = PerspectiveCrop(size=56)
    together = module(images, K, masks, image_index=index)
    for b, i in enumerate(index.tolist()):
        alone = module(images[i : i + 1], K[i : i + 1], masks[b : b + 1])
        assert torch.equal(together.images[b], alone.images[0])
        assert torch.allclose(together.K_crop[b], alone.K_crop[0])


def test_antialiasing_where_the_crop_shrinks():
    # A checkerboard of single pixels has mean 0.5; shrunk 8 times it must be flat grey, not aliased.
    v, u = torch.meshgrid(torch.arange(800), torch.arange(800), indexing="ij")
    image = ((u + v) % 2).float().expand(1, 3, 800, 800)
    K = intrinsics_matrix(1000.0, 1000.0, 399.5, 399.5)[None]
    box = torch.tensor([[49.2, 49.2, 749.2, 749.2]])
    smooth = PerspectiveCrop(size=100, fill=0.83)(image, K, boxes=box).images[0, 0, 10:90, 10:90]
    rough = PerspectiveCrop(size=100, fill=0.83, antialias=False)(image, K, boxes=box).images[
        0, 0, 10:90, 10:90
    ]
    assert (smooth - 0.5).abs().max() < 0.01
    assert rough.std() > 0.1
    # The pyramid keeps its pixels where they belong: a ramp stays a ramp, also at odd sizes.
    ramp = ramp_image(333, 451, torch.float64)
    scale = 0.21
    H = torch.tensor([[scale, 0, 0.5 * scale - 0.5], [0, scale, 0.5 * scale - 0.5], [0, 0, 1.0]]).double()[
        None
    ]
    out = warp_images(ramp, H, torch.zeros(1, dtype=torch.int64), torch.tensor([2.3]).double(), 60)[0]
    expected = (torch.arange(60, dtype=torch.float64) + 0.5) / scale - 0.5
    assert (out[0, 5:-5, 5:-5] - expected[None, 5:-5]).abs().max() < 1e-4
    assert (out[1, 5:-5, 5:-5] - expected[5:-5, None]).abs().max() < 1e-4


def test_gradients_to_image_intrinsics_and_box():
    gen = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 12, 14, generator=gen, dtype=torch.float64, requires_grad=True)
    top = intrinsics_matrix(20.0, 21.0, 6.3, 5.4).double()[:2].requires_grad_()
    bottom = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    box = torch.tensor([[3.1, 2.2, 8.4, 7.3]], dtype=torch.float64, requires_grad=True)
    module = PerspectiveCrop(size=7, antialias=False)

    def crop(i, k, b):
        return module(i, torch.cat([k, bottom])[None], boxes=b)

    assert torch.autograd.gradcheck(lambda i, k, b: crop(i, k, b).images, (image, top, box), eps=1e-7)
    assert torch.autograd.gradcheck(lambda k, b: crop(image.detach(), k, b)[2:4], (top, box))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_pictures_and_mixed_types(dtype):
    image = torch.rand(1, 3, 60, 80, generator=torch.Generator().manual_seed(2))
    K = intrinsics_matrix(100.0, 101.0, 39.5, 29.5)[None].double()
    mask = disc_mask(60, 80, 50, 30, 9)[None]
    module = PerspectiveCrop(size=56)
    half, full = module(image.to(dtype), K, mask), module(image, K, mask)
    assert half.images.dtype == dtype
    assert half.K_crop.dtype == full.K_crop.dtype == torch.float32
    assert torch.equal(half.K_crop, full.K_crop)
    assert (half.images.float() - full.images).abs().max() < 0.01
    integer_box = module(image, K, boxes=torch.tensor([[40, 20, 60, 40]]))
    assert integer_box.boxes.dtype == torch.float32
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(module(image, K, mask).images, full.images)


def test_unusable_cameras_are_flagged():
    image = torch.rand(5, 3, 40, 40, generator=torch.Generator().manual_seed(0))
    K = intrinsics_matrix(50.0, 50.0, 19.5, 19.5).repeat(5, 1, 1)
    K[1], K[2], K[3, 0, 0], K[4, 2, 2] = 0.0, torch.nan, -50.0, 2.0
    crops = PerspectiveCrop(size=28)(image, K, disc_mask(40, 40, 20, 20, 8).expand(5, 40, 40))
    assert crops.valid.tolist() == [True, False, False, False, False]
    assert all(torch.isfinite(t).all() for t in crops)


def test_crops_of_one_image_share_its_memory():
    image = torch.rand(1, 3, 1500, 2000, generator=torch.Generator().manual_seed(0))
    homographies, index = torch.eye(3).repeat(20, 1, 1), torch.zeros(20, dtype=torch.int64)
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities, profile_memory=True) as profile:
        warp_images(image, homographies, index, torch.zeros(20), 28)
    allocated = sum(max(event.self_cpu_memory_usage, 0) for event in profile.key_averages())
    # One copy of the picture takes 36 MB.
    assert 0 < allocated < image.numel() * 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": torch.rand(1, 4, 20, 20)}, r"images must be floating point \(N, 3, H, W\)"),
        ({"images": torch.zeros(1, 3, 20, 20, dtype=torch.uint8)}, "uint8"),
        ({"K": torch.eye(3)}, r"K must have shape \(1, 3, 3\)"),
        ({"masks": torch.ones(20, 20)}, r"masks must have shape \(B, 20, 20\)"),
        ({"masks": torch.ones(1, 10, 20)}, r"masks must have shape \(B, 20, 20\)"),
        ({"masks": None}, "give masks"),
        ({"masks": torch.ones(2, 20, 20)}, "image_index is needed"),
        ({"image_index": torch.tensor([0.5])}, "image_index must be"),
        ({"image_index": torch.tensor([True])}, r"image_index must be .* torch\.bool"),
        ({"image_index": torch.tensor([-1])}, r"image_index must lie in \[0, 1\), got \[-1\]"),
        ({"image_index": torch.tensor([3])}, r"image_index must lie in \[0, 1\), got \[3\]"),
        ({"boxes": torch.ones(1, 5)}, r"boxes must have shape \(B, 4\)"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {"images": torch.rand(1, 3, 20, 20), "K": torch.eye(3)[None], "masks": torch.ones(1, 20, 20)}
    with pytest.raises(ValueError, match=message):
        PerspectiveCrop(size=14)(**(arguments | change))
    with pytest.raises(ValueError, match="fill"):
        PerspectiveCrop(fill=1.5)
    with pytest.raises(ValueError, match=r"background must be one of \('keep', 'black'\), got 'white'"):
        PerspectiveCrop(background="white")


def test_black_background_hides_what_is_outside_the_mask_and_nothing_else():
    g = torch.Generator().manual_seed(5)
    image = 0.1 + 0.9 * torch.rand(1, 3, 120, 160, generator=g)
    K = intrinsics_matrix(200.0, 200.0, 79.5, 59.5)[None]
    masks = torch.stack([disc_mask(120, 160, 100, 60, 15), disc_mask(120, 160, 20, 40, 40)])
    index = torch.zeros(2, dtype=torch.int64)
    kept = PerspectiveCrop(size=84)(image, K, masks, image_index=index)
    black = PerspectiveCrop(size=84, background="black")(image, K, masks, image_index=index)
    for name in ("masks", "K_crop", "T_crop_from_camera", "boxes", "valid"):
        assert torch.equal(getattr(kept, name), getattr(black, name)), name
    inside = (kept.masks > 0.5)[:, None].expand_as(kept.images)
    assert 0.1 < inside.float().mean() < 0.5
    assert torch.equal(black.images[inside], kept.images[inside])
    assert (black.images[~inside] == 0).all()
    assert (kept.images[~inside] > 0).any()


def test_black_background_of_boxes_and_of_unusable_masks():
    image = torch.full((1, 3, 60, 60), 0.5)
    K = intrinsics_matrix(100.0, 100.0, 29.5, 29.5)[None]
    module = PerspectiveCrop(size=50, fill=0.6, antialias=False, background="black")
    box = torch.tensor([[14.5, 14.5, 44.5, 44.5]])
    crops = module(image, K, boxes=box)
    # 30 pixels across, on the axis: 30 pixels in the crop.
    expected = torch.zeros(50, 50)
    expected[10:40, 10:40] = 0.5
    torch.testing.assert_close(crops.images[0], expected.expand(3, 50, 50))
    empty = module(image, K, torch.zeros(1, 60, 60))
    assert not empty.valid[0]
    assert (empty.images == 0).all()


def test_gradient_of_a_black_background_is_that_of_what_is_inside():
    image = torch.rand(1, 3, 40, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    image.requires_grad_()
    K = intrinsics_matrix(60.0, 60.0, 19.5, 19.5).double()[None]
    mask = disc_mask(40, 40, 20, 20, 8)[None]
    crops = {b: PerspectiveCrop(size=30, background=b)(image, K, mask) for b in ("keep", "black")}
    weight = torch.rand(3, 30, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    inside = crops["keep"].masks > 0.5
    (expected,) = torch.autograd.grad((crops["keep"].images * weight * inside).sum(), image)
    (gradient,) = torch.autograd.grad((crops["black"].images * weight).sum(), image)
    assert expected.abs().max() > 0
    torch.testing.assert_close(gradient, expected)

"""Pinhole cameras. Integer pixel coordinates are pixel centres: an image spans ``[-0.5, W - 0.5]``."""

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform


def project_points(points_camera: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Project points in the camera frame to pixels.

    Args:
        points_camera: (..., N, 3), z forward.
        K: (..., 3, 3) intrinsics in pixels, leading dimensions broadcast.

    Returns:
        Pixel coordinates (..., N, 2) and depths (..., N). Where the depth is not positive the pixel is finite
        but means nothing: test the depth.

    Differentiable w.r.t. both arguments (depths of about zero are held fixed, so that the gradient is finite).
    """
    depth = points_camera[..., 2]
    tiny = torch.finfo(depth.dtype).eps
    safe = torch.where(depth.abs() < tiny, torch.full_like(depth, tiny), depth)
    rays = points_camera / safe.unsqueeze(-1)
    return (rays @ K.transpose(-1, -2))[..., :2], depth


def pixel_rays(pixels: Tensor, K: Tensor) -> Tensor:
    """Rays through pixels, with z = 1, in the camera frame.

    Args:
        pixels: (..., N, 2) pixel coordinates.
        K: (..., 3, 3) intrinsics, leading dimensions broadcast.

    Returns:
        (..., N, 3). Differentiable w.r.t. both arguments.
    """
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    return homogeneous @ torch.linalg.inv(K).transpose(-1, -2)


def unproject_pixels(pixels: Tensor, depth: Tensor, K: Tensor) -> Tensor:
    """Lift pixels (..., N, 2) with depths (..., N) (z, not distance) to points (..., N, 3) in the camera frame.

    Differentiable w.r.t. all arguments.
    """
    return pixel_rays(pixels, K) * depth.unsqueeze(-1)


def pixel_grid(height: int, width: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Pixel centres (H, W, 2) as ``(u, v)``."""
    v, u = torch.meshgrid(
        torch.arange(height, device=device, dtype=dtype),
        torch.arange(width, device=device, dtype=dtype),
        indexing="ij",
    )
    return torch.stack([u, v], dim=-1)


def shift_intrinsics(K: Tensor, left_top: Tensor) -> Tensor:
    """Intrinsics after cutting pixels off: (..., 3, 3) and (..., 2) → (..., 3, 3), ``c' = c - left_top``.

    Differentiable w.r.t. both arguments.
    """
    shift = torch.zeros_like(K)
    shift[..., :2, 2] = left_top
    return K - shift


def resize_intrinsics(K: Tensor, scale: float) -> Tensor:
    """Intrinsics after resizing the image by ``scale``: ``f' = s f``, ``c' = (c + 0.5) s - 0.5``.

    Differentiable w.r.t. ``K``.
    """
    scaling = torch.tensor(
        [[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]],
        device=K.device,
        dtype=K.dtype,
    )
    return scaling @ K


def intrinsics_matrix(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """A (3, 3) float32 intrinsic matrix from focal lengths and principal point in pixels."""
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def axis_rotation_to_ray(rays: Tensor) -> Tensor:
    """Smallest rotation of a camera that brings its optical axis onto a ray (so without roll).

    Args:
        rays: (..., 3) directions in the camera frame, z > 0, any length.

    Returns:
        ``R_new_from_camera`` (..., 3, 3): maps the ray onto +z. Differentiable w.r.t. ``rays``.
    """
    d = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    x, y, z = d.unbind(-1)
    # Rodrigues with axis d × e_z and cosine z; 1 / (1 + z) is smooth for every ray in front of the camera.
    k = 1.0 / (1.0 + z)
    rows = [
        torch.stack([1.0 - k * x * x, -k * x * y, -x], dim=-1),
        torch.stack([-k * x * y, 1.0 - k * y * y, -y], dim=-1),
        torch.stack([x, y, z], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def camera_on_boxes(boxes: Tensor, K: Tensor, size: int, fill: float) -> tuple[Tensor, Tensor]:
    """Virtual square cameras focused on 2D boxes (paper, "Perspective cropping").

    The optical axis passes through the centre of the box; the longer side of the box's image in the virtual
    camera is ``fill * size`` pixels.

    Args:
        boxes: (B, 4) as ``(left, top, right, bottom)`` pixel edges.
        K: (B, 3, 3) intrinsics.
        size: side S of the virtual image in pixels.
        fill: δ, the share of the side that the box takes.

    Returns:
        ``K_crop`` (B, 3, 3) and ``T_crop_from_camera`` (B, 4, 4). Differentiable w.r.t. ``boxes`` and ``K`` (where
        width and height tie for the longer side, half of either's gradient).
    """
    left, top, right, bottom = boxes.unbind(-1)
    u = torch.stack([left, right, right, left, (left + right) / 2], dim=-1)
    v = torch.stack([top, top, bottom, bottom, (top + bottom) / 2], dim=-1)
    rays = pixel_rays(torch.stack([u, v], dim=-1), K)
    R = axis_rotation_to_ray(rays[..., 4, :])
    turned = rays[..., :4, :] @ R.transpose(-1, -2)
    plane = turned[..., :2] / turned[..., 2:]
    extent = (plane.amax(-2) - plane.amin(-2)).amax(-1)
    focal = fill * size / extent
    centre = torch.full_like(focal, (size - 1) / 2)
    zero, one = torch.zeros_like(focal), torch.ones_like(focal)
    K_crop = torch.stack([focal, zero, centre, zero, focal, centre, zero, zero, one], dim=-1)
    return K_crop.reshape(*focal.shape, 3, 3), make_transform(R, torch.zeros_like(R[..., 0]))

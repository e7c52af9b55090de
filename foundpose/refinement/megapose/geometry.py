"""What MegaPose's networks see: crop boxes, intrinsics, further views, sampling, and normals as colours.

Boxes are pixel edges in the pictures' frame and intrinsics are ours: the crops of the release follow the same
convention. Its renderings are half a pixel off (their intrinsics count from the corner of a picture), which is taken
care of where they are rendered, in :mod:`foundpose.refinement.megapose.refiner`.
"""

import torch
from torch import Tensor

from foundpose.geometry import boxes_from_points, make_transform, transform_points

MARGIN = 1.4
"""Side of a crop over twice the farthest that the object reaches from its origin."""

SAMPLES = 4
"""Samples of a pixel of a crop, each way."""

_TEXELS = 32  # side of the release's texture of normals


def crop_boxes(
    points_model: Tensor, T_camera_from_model: Tensor, K: Tensor, size: tuple[int, int], near: float
) -> Tensor:
    """Boxes round the images of objects, centred on the images of their origins.

    Args:
        points_model: (P, 3) of the mesh.
        T_camera_from_model: (..., 4, 4).
        K: (..., 3, 3) in pixels.
        size: (height, width) of the crops, which the boxes have the shape of.
        near: depths below this count as this, mesh units.

    Returns:
        (..., 4) as ``(left, top, right, bottom)``. Differentiable w.r.t. ``T_camera_from_model`` and ``K``.
    """

    def project(points: Tensor) -> Tensor:
        image = points @ K.transpose(-1, -2)
        return image[..., :2] / image[..., 2:].clamp(min=near)

    low, high = boxes_from_points(project(transform_points(T_camera_from_model, points_model))).split(
        2, dim=-1
    )
    centre = project(T_camera_from_model[..., None, :3, 3]).squeeze(-2)
    reach = torch.maximum((low - centre).abs(), (high - centre).abs())
    height, width = size
    half = MARGIN * torch.maximum(reach[..., 0], reach[..., 1] * width / height)
    half = torch.stack([half, half * height / width], dim=-1)
    return torch.cat([centre - half, centre + half], dim=-1)


def crop_intrinsics(K: Tensor, boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Intrinsics (..., 3, 3) of crops ``boxes`` (..., 4) that are scaled to ``size`` (height, width).

    Differentiable w.r.t. ``K`` and ``boxes``.
    """
    low, high = boxes.split(2, dim=-1)
    scale = boxes.new_tensor(size[::-1]) / (high - low)
    matrix = torch.diag_embed(torch.cat([scale, torch.ones_like(scale[..., :1])], dim=-1))
    matrix[..., :2, 2] = -low * scale - 0.5
    return matrix @ K


def front_views(T_camera_from_model: Tensor) -> Tensor:
    """Poses in four cameras: the camera, and three that look at the model's origin with the camera's up.

    The first of the three is where the camera is, the others are to its right and left, by as much as the origin is
    away from the camera.

    Args:
        T_camera_from_model: (..., 4, 4).

    Returns:
        (..., 4, 4, 4) ``T_view_from_model``. Differentiable where the origin is not straight above or below.
    """
    origin = T_camera_from_model[..., :3, 3]
    down = torch.zeros_like(origin)
    down[..., 1] = 1.0
    right = torch.nn.functional.normalize(torch.linalg.cross(down, origin, dim=-1), dim=-1)
    right = right * torch.linalg.vector_norm(origin, dim=-1, keepdim=True)
    views = [T_camera_from_model]
    for position in (torch.zeros_like(right), right, -right):
        z = torch.nn.functional.normalize(origin - position, dim=-1)
        x = torch.nn.functional.normalize(torch.linalg.cross(down, z, dim=-1), dim=-1)
        R_view_from_camera = torch.stack([x, torch.linalg.cross(z, x, dim=-1), z], dim=-2)
        t = -(R_view_from_camera @ position.unsqueeze(-1)).squeeze(-1)
        views.append(make_transform(R_view_from_camera, t) @ T_camera_from_model)
    return torch.stack(views, dim=-3)


def sample_boxes(images: Tensor, boxes: Tensor, image_index: Tensor, size: tuple[int, int]) -> Tensor:
    """Crops by the means of 4 × 4 bilinear samples of a pixel, as RoIAlign takes them.

    Samples up to a pixel beyond the outermost pixel centres repeat these; those further out are black. Both ways are
    independent, so a crop is the product of the picture with a matrix on either side.

    Args:
        images: (N, C, H, W).
        boxes: (M, 4).
        image_index: (M,) the picture of each box.
        size: (height, width) of the crops.

    Returns:
        (M, C, height, width). Differentiable w.r.t. ``images`` and ``boxes``.

    Source: He et al., "Mask R-CNN", ICCV 2017.
    """
    left, top, right, bottom = boxes.to(images.dtype).unbind(-1)
    columns = _sampling_matrix(left, right, size[1], images.shape[-1])
    rows = _sampling_matrix(top, bottom, size[0], images.shape[-2])
    rows, columns = rows.unsqueeze(1), columns.unsqueeze(1).transpose(-1, -2)
    crops = images.new_zeros(len(boxes), images.shape[1], *size)
    for picture in image_index.unique().tolist():
        of_picture = torch.nonzero(image_index == picture).flatten()
        crops[of_picture] = rows[of_picture] @ images[picture] @ columns[of_picture]
    return crops


def _sampling_matrix(low: Tensor, high: Tensor, count: int, length: int) -> Tensor:
    """Weights (M, count, length) of pixels in the cells of intervals (M,)."""
    steps = (torch.arange(count * SAMPLES, device=low.device, dtype=low.dtype) + 0.5) / (count * SAMPLES)
    place = low[:, None] + steps * (high - low).clamp(min=1.0)[:, None]
    inside = ((place >= -1.0) & (place <= length)).to(low.dtype) / SAMPLES
    place = place.clamp(0.0, length - 1.0)
    first = place.detach().floor()
    share = place - first
    index = torch.cat([first, (first + 1.0).clamp(max=length - 1.0)], dim=1).long()
    weight = torch.cat([(1.0 - share) * inside, share * inside], dim=1)
    cell = (torch.arange(count * SAMPLES, device=low.device) // SAMPLES).repeat(2)
    matrix = weight.new_zeros(len(low), count * length)
    return matrix.scatter_add(1, cell * length + index, weight).unflatten(1, (count, length))


def normal_colors(normals: Tensor, mask: Tensor) -> Tensor:
    """Normals as the release's renderer colours them: looked up in a texture of 32³ colours that repeats.

    Red, green and blue are the components to the right, away from the camera and up; a negative component comes out
    one larger.

    Args:
        normals: (..., 3, H, W) unit length, camera frame.
        mask: (..., H, W) bool, where there are any.

    Returns:
        (..., 3, H, W) in [0, 1], black outside the mask.
    """
    x, y, z = normals.unbind(-3)
    place = torch.stack([x, z, -y], dim=-3) * _TEXELS - 0.5
    first = place.floor()
    low, high = (((index % _TEXELS) * (255.0 / _TEXELS)).floor_() for index in (first, first + 1.0))
    color = torch.lerp(low, high, place - first) / 255.0
    return color * mask.unsqueeze(-3)

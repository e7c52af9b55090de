"""Virtual cameras of the templates and the patches registered in 3D."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry import (
    boxes_from_points,
    camera_on_boxes,
    grow_masks,
    invert_transform,
    make_transform,
    pixel_grid,
    project_points,
    transform_points,
    unproject_pixels,
)
from foundpose.geometry.patch_grid import PatchGrid
from foundpose.rendering import Mesh, Renderer


class TemplateCameras(NamedTuple):
    """Cameras that see the object at a fixed size.

    Attributes:
        T_template_from_model: (T, 4, 4), mesh units.
        K_template: (T, 3, 3) in pixels of the template.
    """

    T_template_from_model: Tensor
    K_template: Tensor


def template_cameras(
    mesh: Mesh, rotations: Tensor, size: int, fill: float, distance: float
) -> TemplateCameras:
    """Place crop cameras so that the longer side of the object's 2D box is ``fill * size`` pixels.

    Args:
        mesh: the object.
        rotations: (T, 3, 3) ``R_camera_from_model``.
        size: side of a template in pixels.
        fill: δ, share of the side that the object's box takes.
        distance: distance of the object's centre in diameters.

    Returns:
        Cameras in the dtype and on the device of ``rotations``.

    Source: paper, "Template generation".
    """
    hull = mesh.hull_vertices.to(rotations)
    centre = (hull.amin(0) + hull.amax(0)) / 2
    offset = rotations.new_tensor([0.0, 0.0, distance * mesh.diameter])
    T = make_transform(rotations, offset - rotations @ centre)
    K = torch.eye(3, device=rotations.device, dtype=rotations.dtype).expand(len(rotations), 3, 3)
    # Turning the camera changes the box a little, so the camera is focused until nothing moves.
    for _ in range(3):
        boxes = boxes_from_points(project_points(transform_points(T, hull), K)[0])
        K, T_turn = camera_on_boxes(boxes, K, size, fill)
        T = T_turn @ T
    return TemplateCameras(T, K)


class RegisteredPatches(NamedTuple):
    """Where the patches of templates lie on the object.

    Attributes:
        points_model: (B, h, w, 3) point seen at each patch centre, mesh units; zero where not valid.
        valid: (B, h, w) bool.
    """

    points_model: Tensor
    valid: Tensor


def register_patches(
    renderer: Renderer,
    mesh: Mesh,
    cameras: TemplateCameras,
    masks: Tensor,
    grid: PatchGrid,
    erosion: int,
) -> RegisteredPatches:
    """Find the 3D point behind the centre of every patch (paper, "Patch descriptors registered in 3D").

    The depth is rendered at the patch centres themselves, so it is not interpolated across depth edges.

    Args:
        renderer: renders the depth.
        mesh: the object.
        cameras: of B templates.
        masks: (B, S, S) bool, masks of the templates.
        grid: where their patches lie.
        erosion: a patch is valid if its centre lies inside the mask eroded by a square of this many pixels
            (odd; 0 or 1 for no erosion).
    """
    T, K = cameras
    # Intrinsics of an image whose pixel centres are the patch centres.
    scale, shift, n = 1 / grid.stride, -grid.offset / grid.stride, grid.size
    K_grid = K.new_tensor([[scale, 0.0, shift], [0.0, scale, shift], [0, 0, 1]]) @ K
    render = renderer(mesh, T, K_grid, (n, n))
    inside = grow_masks(masks, -(erosion // 2)).to(K.dtype)[:, None]
    valid = render.mask & (grid.sample(inside)[:, 0] > 0.999)
    pixels = pixel_grid(n, n, K.device, K.dtype).reshape(1, -1, 2)
    points_template = unproject_pixels(pixels, render.depth.flatten(1), K_grid)
    points_model = transform_points(invert_transform(T), points_template)
    points_model = points_model.reshape(len(masks), n, n, 3)
    return RegisteredPatches(
        torch.where(valid[..., None], points_model, torch.zeros_like(points_model)), valid
    )

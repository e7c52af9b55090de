"""Pictures whose colours are model coordinates, for experiments that need true correspondences."""

from collections.abc import Sequence

import torch
from torch import Tensor

from foundpose.geometry import pixel_grid, transform_points, unproject_pixels
from foundpose.rendering.base import RenderOutput
from foundpose.rendering.mesh import Mesh
from foundpose.rendering.raycast import RaycastRenderer

# Colours of the surface lie in [0.1, 0.9], so that black stands for the background.
COLOR_CENTRE = 0.5
COLOR_RANGE = 0.8


class CoordinateRenderer(RaycastRenderer):
    """Renders where on the object each pixel lies: red, green and blue are x, y and z.

    A coordinate is given relative to the centre of the mesh's box and in diameters, so an object spans at most
    [-0.5, 0.5], which becomes [0.1, 0.9].
    """

    bits = 16  # 8 would move a point by up to 0.2 % of the diameter

    def __init__(self) -> None:
        super().__init__(supersampling=1)

    def forward(
        self, mesh: Mesh, T_camera_from_model: Tensor, K: Tensor, size: tuple[int, int]
    ) -> RenderOutput:
        """Render as :class:`RaycastRenderer` does, with coordinates as colours."""
        render = super().forward(mesh, T_camera_from_model, K, size)
        pixels = pixel_grid(*size, render.depth.device, render.depth.dtype).reshape(-1, 2)
        points_camera = unproject_pixels(pixels, render.depth.flatten(1), K.to(render.depth))
        # A true inverse: annotated rotations may be scaled by half a percent.
        points = transform_points(torch.linalg.inv(T_camera_from_model), points_camera)
        centre = mesh.bounds.to(points).mean(dim=0)
        colors = COLOR_CENTRE + COLOR_RANGE * (points - centre) / mesh.diameter
        rgb = colors.transpose(1, 2).reshape(len(points), 3, *size)
        return render._replace(rgb=torch.where(render.mask[:, None], rgb, rgb.new_zeros(())))


def render_coordinate_image(
    renderer: CoordinateRenderer,
    meshes: Sequence[Mesh],
    T_camera_from_model: Sequence[Tensor],
    K: Tensor,
    size: tuple[int, int],
) -> Tensor:
    """Picture of several objects that hide each other, each in its own coordinates.

    Args:
        renderer: the renderer.
        meshes: n objects, all in one unit of length.
        T_camera_from_model: n poses (4, 4).
        K: (3, 3) intrinsics.
        size: (height, width).

    Returns:
        (3, H, W), black where no object is seen.
    """
    image = torch.zeros(3, *size, dtype=K.dtype)
    nearest = torch.full(size, torch.inf, dtype=K.dtype)
    for mesh, T in zip(meshes, T_camera_from_model, strict=True):
        render = renderer(mesh, T[None].to(K), K[None], size)
        in_front = render.mask[0] & (render.depth[0] < nearest)
        nearest = torch.where(in_front, render.depth[0], nearest)
        image = torch.where(in_front, render.rgb[0], image)
    return image

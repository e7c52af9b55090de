"""The pose of a retrieved template, moved to where the object is seen."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry.cameras import pixel_rays, project_points
from foundpose.geometry.circles import Circles, smallest_enclosing_circles
from foundpose.geometry.transforms import make_transform, transform_points
from foundpose.pnp.ransac import PnpStatus
from foundpose.representation import ObjectRepresentation

# The error falls about tenfold with each round.
_ROUNDS = 5
# Change of the depth in the last round above which the circles do not come together.
_LARGEST_LAST_STEP = 0.01
# Radius in pixels of a circle around as good as nothing.
_SMALLEST_RADIUS = 0.5
# Extreme points of each template that are kept, and templates looked at together.
_NUM_DIRECTIONS = 8
_TEMPLATES_PER_BLOCK = 128


class TemplatePoses(NamedTuple):
    """Poses of retrieved templates after alignment.

    Attributes:
        T_crop_from_model: (B, h, 4, 4), mesh units, always finite. Where ``success`` is False it is the template's
            own pose: test the flag.
        success: (B, h) bool, ``status`` is OK.
        status: (B, h) int64, values of :class:`PnpStatus`; DEGENERATE where a circle has no extent (an empty mask)
            or the circles cannot be aligned, BEHIND_CAMERA where the object would reach behind the camera.
    """

    T_crop_from_model: Tensor
    success: Tensor
    status: Tensor


class TopTemplatePose(nn.Module):
    """Poses of the retrieved templates, moved so that the object's bounding circle is that of the mask.

    :class:`foundpose.TemplateHypotheses` uses it in place of matching and PnP.

    Source: paper, "Template retrieval", and Table 2, row 10.
    """

    def forward(
        self, masks: Tensor, K: Tensor, template_index: Tensor, templates: ObjectRepresentation
    ) -> TemplatePoses:
        """Align the templates' poses with B crops of one object.

        Args:
            masks: (B, S, S), inside where above 0.5.
            K: (B, 3, 3) intrinsics of the crops.
            template_index: (B, h) retrieved templates.
            templates: the object's templates.

        Returns:
            One pose for each crop and template.

        Raises:
            ValueError: shapes do not fit.

        Differentiable w.r.t. ``K``, ``templates.points_model`` and ``templates.T_template_from_model``. The circle
        of the mask is constant, and so is which points determine a circle.
        """
        if masks.ndim != 3 or K.shape != (len(masks), 3, 3):
            raise ValueError(
                f"masks and K must have shapes (B, S, S) and (B, 3, 3), got {tuple(masks.shape)} and {tuple(K.shape)}"
            )
        if template_index.ndim != 2 or len(template_index) != len(masks):
            raise ValueError(
                f"template_index must have shape ({len(masks)}, h), got {tuple(template_index.shape)}"
            )
        T = templates.T_template_from_model[template_index].to(K)
        return align_bounding_circles(T, outline_points(templates).to(K), mask_circles(masks, K.dtype), K)


def mask_circles(masks: Tensor, dtype: torch.dtype) -> Circles:
    """Smallest circles around the pixel centres inside of masks (B, S, S), which are those above 0.5."""
    inside = masks > 0.5
    height, width = masks.shape[-2:]
    # The first and the last pixel of each row have the same convex hull, hence the same circle, as all of them.
    first = inside.to(torch.uint8).argmax(dim=2)
    last = width - 1 - inside.flip(2).to(torch.uint8).argmax(dim=2)
    row = torch.arange(height, device=masks.device).expand_as(first)
    ends = torch.stack([torch.cat([first, last], dim=1), torch.cat([row, row], dim=1)], dim=-1)
    occupied = inside.any(dim=2)
    return smallest_enclosing_circles(ends.to(dtype), torch.cat([occupied, occupied], dim=1))


def outline_points(templates: ObjectRepresentation) -> Tensor:
    """Points of an object that are outermost in some template: (8 T, 3), mesh units.

    The patches of one template lie on a coarse grid, and those at the silhouette are left out: a circle around them
    is too small, by an amount that varies with the place of the grid. The patches of all templates together cover
    the object closely, and whatever is outermost in one view is outermost in the views beside it. So what a mask
    shows is compared with the outermost points of all templates, not with the patches of one.

    Differentiable w.r.t. ``templates.points_model``; the choice of points is constant.
    """
    points = templates.points_model
    start, count = templates.template_offsets[:-1], templates.template_offsets.diff()
    angle = torch.arange(_NUM_DIRECTIONS, device=points.device) * (2.0 * torch.pi / _NUM_DIRECTIONS)
    directions = torch.stack([angle.cos(), angle.sin()]).to(points.dtype)
    position = torch.arange(max(templates.max_patches, 1), device=points.device)
    # Past a template's last patch, the last is repeated; a template without patches borrows a neighbour's.
    rows = start[:, None] + torch.minimum(position, (count - 1).clamp(min=0)[:, None])
    rows = rows.clamp(max=len(points) - 1)
    R = templates.T_template_from_model[:, :2, :3].detach().to(points)
    chosen = []
    for rows_block, R_block in zip(
        rows.split(_TEMPLATES_PER_BLOCK), R.split(_TEMPLATES_PER_BLOCK), strict=True
    ):
        reach = points.detach()[rows_block] @ R_block.transpose(1, 2) @ directions
        chosen.append(rows_block.gather(1, reach.argmax(dim=1)).flatten())
    return points[torch.cat(chosen)]


def align_bounding_circles(T: Tensor, points_model: Tensor, target: Circles, K: Tensor) -> TemplatePoses:
    """Move objects so that the circle around their projection is a given one.

    The viewing ray through the circle's centre is turned onto the target's, and the object with it, so that it is
    seen from the side that it was seen from; then it is moved along the ray by the ratio of the radii. Perspective
    makes this inexact, so it is repeated.

    Args:
        T: (B, h, 4, 4) poses from which to start, mesh units.
        points_model: (N, 3) points of the object, mesh units.
        target: B circles in pixels.
        K: (B, 3, 3) intrinsics.

    Differentiable w.r.t. ``T``, ``points_model``, ``target`` and ``K``.
    """
    B, h = T.shape[:2]
    usable = target.valid & (target.radius > _SMALLEST_RADIUS)
    centre = torch.where(usable[:, None], target.centre, K[:, :2, 2].detach())
    radius = target.radius.where(usable, 1.0)
    K = K.unsqueeze(1)
    goal = _unit_rays(centre.unsqueeze(1), K[:, 0]).expand(-1, h, -1)
    middle = (points_model.amin(dim=0) + points_model.amax(dim=0)) / 2.0
    moved, extent, step = T, T.new_zeros(B, h), T.new_zeros(B, h)
    for _ in range(_ROUNDS):
        pixels, _ = project_points(transform_points(moved, points_model), K)
        circle = smallest_enclosing_circles(pixels.flatten(0, 1))
        extent = circle.radius.unflatten(0, (B, h))
        R = rotation_between(_unit_rays(circle.centre.unflatten(0, (B, h)), K[:, 0]), goal)
        R_moved = R @ moved[..., :3, :3]
        t = (R @ moved[..., :3, 3:]).squeeze(-1)
        step = extent / radius.unsqueeze(1)
        away = (R_moved @ middle) + t
        moved = make_transform(R_moved, t + (step - 1.0).unsqueeze(-1) * away)
    depth = transform_points(moved, points_model)[..., 2]
    finite = torch.isfinite(moved).flatten(2).all(dim=2)
    aligned = finite & usable.unsqueeze(1) & (extent > _SMALLEST_RADIUS)
    aligned = aligned & ((step - 1.0).abs() < _LARGEST_LAST_STEP)
    status = torch.full((B, h), int(PnpStatus.OK), device=T.device)
    status = status.masked_fill(~(depth > 0).all(dim=2), int(PnpStatus.BEHIND_CAMERA))
    status = status.masked_fill(~aligned, int(PnpStatus.DEGENERATE))
    success = status == int(PnpStatus.OK)
    return TemplatePoses(torch.where(success[..., None, None], moved, T), success, status)


def rotation_between(a: Tensor, b: Tensor) -> Tensor:
    """Smallest rotations (..., 3, 3) that turn unit vectors (..., 3) onto others, which must not be opposite.

    Differentiable w.r.t. both arguments.
    """
    x, y, z = torch.linalg.cross(a, b).unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    W = torch.stack(rows, dim=-2)
    cosine = (a * b).sum(dim=-1)[..., None, None]
    return torch.eye(3, dtype=a.dtype, device=a.device) + W + W @ W / (1.0 + cosine)


def _unit_rays(pixels: Tensor, K: Tensor) -> Tensor:
    """Directions (B, n, 3) through pixels (B, n, 2) of cameras (B, 3, 3)."""
    rays = pixel_rays(pixels, K)
    return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)

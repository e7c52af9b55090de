"""One picture that tells how a pose came about."""

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from foundpose.geometry import grow_masks, project_points, resize_intrinsics, transform_points
from foundpose.geometry.warp import sample_pixels, warped_pixels
from foundpose.pipeline.results import PoseEstimates, PoseStatus
from foundpose.refinement import Observation
from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.visualization.overlay import (
    COARSE,
    REFINED,
    TRUTH,
    Color,
    draw_axes,
    draw_contour,
    from_pil,
    to_pil,
)
from foundpose.visualization.tiles import (
    captioned,
    draw_patches,
    principal_colors,
    resized,
    side_by_side,
    stacked,
)

_SIDE = 300  # pixels of a tile
_TEMPLATES = 7  # that are shown
_LINES = 60  # that are drawn
_POINTS = 30_000  # that stand in for a mesh


class ObjectView:
    """Draws an object as a camera sees it: from its mesh, or without one the outline of its templates' points.

    Args:
        representation: of the object.
        mesh: the object; None draws outlines only.
    """

    def __init__(self, representation: ObjectRepresentation, mesh: Mesh | None) -> None:
        self.mesh = mesh
        self.renderer = RaycastRenderer()
        self.outliner = RaycastRenderer(supersampling=1)
        points = representation.points_model
        self.points = points[:: max(1, len(points) // _POINTS)].float().cpu()

    def outline(self, T: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
        """Mask (H, W) bool of the object under a pose (4, 4) in a picture (height, width) with intrinsics (3, 3)."""
        if self.mesh is not None:
            return self.outliner(self.mesh, T[None], K[None], size).mask[0]
        pixels, depth = project_points(transform_points(T, self.points), K)
        u, v = pixels.round().long().unbind(1)
        seen = (depth > 0) & (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
        mask = torch.zeros(size, dtype=torch.bool)
        mask[v[seen], u[seen]] = True
        # Points lie apart: what is between them belongs to the object.
        return grow_masks(grow_masks(mask, 2), -2)


@torch.no_grad()
def draw_estimate(
    estimates: PoseEstimates, index: int, T_true: Tensor | None = None, note: str = ""
) -> Image.Image:
    """Draw how a pose came about.

    From the top: the picture, the crop with its mask, and the crop with the poses' contours (truth red, coarse pose
    blue, refined green); the retrieved templates with their similarities and inliers; the inlier matches of the best
    one, and both with the principal components of their descriptors as colours. Templates are rendered where the
    pipeline was given meshes; else their colours alone are shown.

    Args:
        estimates: a batch of estimates.
        index: which estimate to draw.
        T_true: (4, 4) true ``T_camera_from_model``, or None.
        note: a line of text below the title.

    Returns:
        A picture about 1200 pixels wide; takes about a tenth of a second.

    Raises:
        ValueError: no such estimate, or estimates without the observation that they were made from.
    """
    if estimates.observation is None:
        raise ValueError(
            "these estimates have lost the observation that they were made from, and cannot be drawn"
        )
    if not -len(estimates.valid) <= index < len(estimates.valid):
        raise ValueError(f"index must be one of the {len(estimates.valid)} estimates, got {index}")
    return _EstimateFigure(estimates, estimates.observation, index % len(estimates.valid)).draw(T_true, note)


class _EstimateFigure:
    """The parts of the picture of an estimate."""

    def __init__(self, estimates: PoseEstimates, observation: Observation, index: int) -> None:
        which = int(observation.groups.object_index[index])
        self.e, self.index = estimates, index
        self.representation = observation.groups.objects[which]
        mesh = None if observation.meshes is None else observation.meshes[which]
        self.view = ObjectView(self.representation, mesh)
        picture = int(observation.image_index[index])
        self.photograph = observation.images[picture].float().cpu()
        self.K = observation.K[picture].float().cpu()
        self.crop = estimates.crops.images[index].float().cpu()
        self.scale = _SIDE / self.crop.shape[-1]
        self.best = int(estimates.best[index])
        self.templates = estimates.templates.index[index]
        patches = self.representation.gather_templates(self.templates, 3)
        self.template_patches = type(patches)(*(x.cpu() for x in patches))
        valid = estimates.query.valid[index]
        self.query_pixels = estimates.query.pixels[index][valid].float().cpu()
        colors = principal_colors(
            estimates.query.descriptors[index][valid].cpu(),
            self.template_patches.descriptors[self.template_patches.valid],
        )
        self.query_colors = colors[0]
        self.template_colors = torch.zeros(*self.template_patches.valid.shape, 3)
        self.template_colors[self.template_patches.valid] = colors[1]

    def draw(self, T_true: Tensor | None, note: str) -> Image.Image:
        """All parts below a title."""
        e, i = self.e, self.index
        title = (
            f"{self.representation.info.name}: {PoseStatus(int(e.status[i])).name}, score {float(e.score[i]):.2f}, "
            f"{int(e.num_inliers[i])} inliers of {int(e.query.valid[i].sum())} patches"
        )
        rows = [self._pictures(T_true), self._retrieved(), side_by_side([self._matches(), *self._colors()])]
        sheet = stacked(rows)
        for line in filter(None, (note, title)):
            sheet = captioned(sheet, f"  {line}")
        return sheet

    def _pictures(self, T_true: Tensor | None) -> Image.Image:
        e, i = self.e, self.index
        poses: list[tuple[str, Color, Tensor]] = []
        if T_true is not None:
            poses.append(("truth red", TRUTH, T_true.float().cpu()))
        if bool(e.valid[i]):
            poses.append(("coarse blue", COARSE, e.T_coarse[i].float().cpu()))
            if e.refined is not None:
                poses.append(("refined green", REFINED, e.T_camera_from_model[i].float().cpu()))
        whole = from_pil(resized(self.photograph, _SIDE))
        K = resize_intrinsics(self.K, _SIDE / self.photograph.shape[1])
        K_crop = resize_intrinsics(e.crops.K_crop[i].float().cpu(), self.scale)
        T_crop = e.crops.T_crop_from_camera[i].float().cpu()
        mask = from_pil(resized(e.crops.masks[i].float().cpu().expand(3, -1, -1), _SIDE))[0] > 0.5
        close = sample_pixels(
            self.photograph[None],
            warped_pixels((K_crop @ T_crop[:3, :3] @ torch.linalg.inv(self.K))[None], _SIDE),
        )[0]
        masked = draw_contour(from_pil(resized(self.crop, _SIDE)), mask, (1.0, 1.0, 1.0), width=1)
        for _, color, T in poses:
            whole = draw_contour(whole, self.view.outline(T, K, (whole.shape[1], whole.shape[2])), color, 1)
            close = draw_contour(close, self.view.outline(T_crop @ T, K_crop, (_SIDE, _SIDE)), color)
        if bool(e.valid[i]):
            length = 0.5 * self._extent()
            close = draw_axes(close, T_crop @ e.T_camera_from_model[i].float().cpu(), K_crop, length)
        tiles = [
            captioned(to_pil(whole), "picture"),
            captioned(to_pil(masked), "crop; outline of the mask white"),
            captioned(to_pil(close), ", ".join(name for name, _, _ in poses) or "no pose"),
        ]
        return side_by_side(tiles)

    def _extent(self) -> float:
        low, high = self.view.points.amin(dim=0), self.view.points.amax(dim=0)
        return float((high - low).max())

    def _template(self, rank: int, side: int) -> Image.Image:
        """A retrieved template as onboarding saw it, or the colours of its patches."""
        if self.view.mesh is None:
            return self._template_colors(rank, side)
        T = self.representation.T_template_from_model[self.templates[rank]].float().cpu()
        K = self.representation.K_template[self.templates[rank]].float().cpu()
        K = resize_intrinsics(K, side / self.representation.info.image_size)
        return to_pil(self.view.renderer(self.view.mesh, T[None], K[None], (side, side)).rgb[0])

    def _template_colors(self, rank: int, side: int) -> Image.Image:
        patches, info = self.template_patches, self.representation.info
        valid, scale = patches.valid[rank], side / info.image_size
        pixels = (patches.pixels[rank][valid].float() + 0.5) * scale - 0.5
        return draw_patches(pixels, self.template_colors[rank][valid], info.patch_grid.stride * scale, side)

    def _retrieved(self) -> Image.Image:
        e, i = self.e, self.index
        ranks = sorted({*range(min(len(self.templates), _TEMPLATES)), self.best})
        side = (4 * _SIDE) // max(len(ranks), 5)
        tiles = []
        for rank in ranks:
            similarity, inliers = (
                float(e.templates.similarity[i, rank]),
                int(e.hypotheses.num_inliers[i, rank]),
            )
            chosen = ", chosen" if rank == self.best else ""
            tiles.append(
                captioned(self._template(rank, side), f"{rank + 1}: {similarity:.2f}, {inliers} inl.{chosen}")
            )
        return side_by_side(tiles)

    def _matches(self) -> Image.Image:
        """Crop and chosen template, joined by the inlier matches."""
        crop = captioned(resized(self.crop, _SIDE), "inlier matches of the crop …")
        pair = side_by_side([crop, captioned(self._template(self.best, _SIDE), "… and the chosen template")])
        found = self.e.correspondences
        if found is None:
            return pair
        inliers = torch.nonzero(self.e.hypotheses.inliers[self.index, self.best].cpu()).flatten()
        inliers = inliers[:: max(1, len(inliers) // _LINES)]
        template_scale = _SIDE / self.representation.info.image_size
        starts = found.points_image[self.index].cpu()[inliers] * self.scale
        ends = found.pixels_template[self.index, self.best].cpu()[inliers] * template_scale
        down = pair.height - _SIDE
        draw = ImageDraw.Draw(pair)
        for k, ((x0, y0), (x1, y1)) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            hue = f"hsl({360 * k // max(len(starts), 1)}, 90%, 55%)"
            draw.line([(x0, y0 + down), (x1 + pair.width - _SIDE, y1 + down)], fill=hue)
        return pair

    def _colors(self) -> list[Image.Image]:
        """Principal components of the patches of crop and chosen template."""
        stride = self.representation.info.patch_grid.stride * self.scale
        pixels = (self.query_pixels + 0.5) * self.scale - 0.5
        return [
            captioned(
                draw_patches(pixels, self.query_colors, stride, _SIDE), "descriptors of the crop as colours"
            ),
            captioned(self._template_colors(self.best, _SIDE), "… and of the chosen template"),
        ]

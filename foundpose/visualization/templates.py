"""What an onboarded object looks like to the method: its templates, their visual words, and their neighbours."""

from collections.abc import Sequence

import torch
from PIL import Image
from torch import Tensor

from foundpose.clustering.assignment import find_nearest
from foundpose.geometry import (
    intrinsics_matrix,
    make_transform,
    project_points,
    resize_intrinsics,
    rotation_angle,
    transform_points,
)
from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.visualization.overlay import to_pil
from foundpose.visualization.tiles import captioned, draw_patches, principal_colors, side_by_side, stacked

_MOST_POINTS = 120_000
_CELLS = 30  # along a diameter


class TemplateViewer:
    """Draws the templates of an object.

    Args:
        representation: of the object.
        mesh: templates are rendered too; None shows their words alone.
        side: of a template's picture, pixels.
    """

    def __init__(
        self, representation: ObjectRepresentation, mesh: Mesh | None = None, side: int = 110
    ) -> None:
        if side < 16:
            raise ValueError(f"side must be at least 16 pixels, got {side}")
        self.representation = representation
        self.mesh = mesh
        self.side = side
        self.word_colors = principal_colors(representation.words)[0]

    @torch.no_grad()
    def words(self, index: int) -> Image.Image:
        """A template's patches, each in the colour of its nearest word: words that are alike have like colours."""
        patches = self.representation.gather_templates(torch.tensor(index))
        word = find_nearest(patches.descriptors[patches.valid], self.representation.words.float())[0]
        scale = self.side / self.representation.info.image_size
        pixels = (patches.pixels[patches.valid] + 0.5) * scale - 0.5
        stride = self.representation.info.patch_grid.stride * scale
        return draw_patches(pixels, self.word_colors[word], stride, self.side)

    def picture(self, index: int) -> Image.Image | None:
        """A template as onboarding saw it; None without a mesh."""
        if self.mesh is None:
            return None
        K = resize_intrinsics(
            self.representation.K_template[index].float(), self.side / self.representation.info.image_size
        )
        T = self.representation.T_template_from_model[index].float()
        return to_pil(RaycastRenderer()(self.mesh, T[None], K[None], (self.side, self.side)).rgb[0])

    def grid(self, indices: Sequence[int], columns: int = 8) -> Image.Image:
        """Templates in a grid: their pictures, if there is a mesh, with their words below."""
        tiles = [self._tile(index, f"template {index}") for index in indices]
        return stacked([side_by_side(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])

    def neighbours(self, index: int, count: int = 7) -> Image.Image:
        """A template, and the others that are nearest to it: by rotation above, by bag of words below."""
        views = self.representation.T_template_from_model[:, :3, :3].float()
        angle = torch.rad2deg(rotation_angle(views[index].expand_as(views), views))
        bags = self.representation.template_bow.float()
        similarity = bags @ bags[index]
        rows = []
        for name, score, unit in (("by rotation", -angle, "°"), ("by words", similarity, "")):
            nearest = score.topk(min(count + 1, len(score))).indices.tolist()
            others = [k for k in nearest if k != index][:count]
            tiles = [self._tile(index, f"{index}, {name}:")]
            for k in others:
                value = (
                    f"{float(angle[k]):.0f}°"
                    if unit
                    else f"{float(similarity[k]):.2f}, {float(angle[k]):.0f}°"
                )
                tiles.append(self._tile(k, f"{k}: {value}"))
            rows.append(side_by_side(tiles))
        return stacked(rows)

    def turntable(self, frames: int = 36, elevation: float = 25.0, side: int = 240) -> list[Image.Image]:
        """The object turning about the model's z axis: points of all templates, coloured by their mean descriptors.

        Args:
            frames: pictures of a whole turn.
            elevation: of the camera above the xy plane, degrees.
            side: of a picture, pixels.
        """
        points, colors = self._cloud()
        centre = (points.amin(0) + points.amax(0)) / 2
        distance = 3.0 * self.representation.info.diameter
        focal = 0.85 * side * 3.0
        K = intrinsics_matrix(focal, focal, (side - 1) / 2, (side - 1) / 2)
        tilt, pictures = torch.deg2rad(torch.tensor(elevation)), []
        for frame in range(frames):
            turn = torch.tensor(2 * torch.pi * frame / frames)
            R = _camera_above(turn, tilt)
            T = make_transform(R, torch.tensor([0.0, 0.0, distance]) - R @ centre)
            cloud = _splat(transform_points(T, points), colors, K, side)
            tiles = [cloud]
            if self.mesh is not None:
                tiles.insert(0, to_pil(RaycastRenderer()(self.mesh, T[None], K[None], (side, side)).rgb[0]))
            pictures.append(side_by_side(tiles))
        return pictures

    def _cloud(self) -> tuple[Tensor, Tensor]:
        """Points (n, 3) of the surface and their colours (n, 3), the means of what all templates say of a place."""
        points = self.representation.points_model.float()
        rows = torch.arange(0, len(points), max(1, len(points) // _MOST_POINTS))
        descriptors = self.representation.read_descriptors(rows, 3).float()
        cells = (points[rows] * (_CELLS / self.representation.info.diameter)).round().long()
        _, cell = cells.unique(dim=0, return_inverse=True)
        count = torch.bincount(cell)
        means = descriptors.new_zeros(len(count), descriptors.shape[1]).index_add(0, cell, descriptors)
        return points[rows], principal_colors(means / count[:, None])[0][cell]

    def _tile(self, index: int, caption: str) -> Image.Image:
        pictures = [p for p in (self.picture(index), self.words(index)) if p is not None]
        return captioned(stacked(pictures), f" {caption}")


def spread_templates(representation: ObjectRepresentation, count: int) -> list[int]:
    """Templates that lie far from each other: each next one is the farthest from those before."""
    views = representation.T_template_from_model[:, :3, :3].float()
    chosen = [0]
    nearest = rotation_angle(views[0].expand_as(views), views)
    while len(chosen) < min(count, len(views)):
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, rotation_angle(views[chosen[-1]].expand_as(views), views))
    return chosen


def _camera_above(turn: Tensor, tilt: Tensor) -> Tensor:
    """Rotation of a camera that looks at the origin from an azimuth and an elevation, z of the model upwards."""
    away = torch.stack([turn.cos() * tilt.cos(), turn.sin() * tilt.cos(), tilt.sin()])
    right = torch.stack([-turn.sin(), turn.cos(), torch.zeros(())])
    return torch.stack([right, torch.linalg.cross(-away, right), -away])


def _splat(points: Tensor, colors: Tensor, K: Tensor, side: int) -> Image.Image:
    """Points (n, 3) in the camera's frame as dots of 3 × 3 pixels, the nearest in front."""
    pixels, depth = project_points(points, K)
    order = depth.argsort(descending=True)
    picture = torch.zeros(3, side, side)
    corner = pixels[order].round().long()
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            u, v = (corner + torch.tensor([du, dv])).clamp(0, side - 1).unbind(1)
            picture[:, v, u] = colors[order].T
    return to_pil(picture)

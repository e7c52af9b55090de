"""What a surface looks like where a ray meets it: attribute interpolation, texture lookup and light.

Every renderer only decides which face is seen at a sample; depth, normals and colours come from here, so all
renderers agree. Everything is NumPy on the CPU, as its callers trace views on several threads: NumPy neither
holds the interpreter lock in its loops nor starts threads of its own.
"""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from foundpose.rendering.mesh import PLAIN_ALBEDO, Mesh, once_per_mesh

AMBIENT = 0.4
"""Share of the light that comes from everywhere; the rest comes from the camera's direction."""

CREASE_COSINE = 0.85
"""A corner whose vertex normal turns further than this (32°) from its face's normal is shaded flat."""

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]
Indices = NDArray[np.integer]


class Hits(NamedTuple):
    """Samples of one view that meet the surface.

    Attributes:
        pixel: (M,) flat indices into the view's window, each at most once.
        face: (M,) faces seen.
        weights: (M, 3) float32 barycentric coordinates on them.
    """

    pixel: Indices
    face: Indices
    weights: Array32


class Surface:
    """Per-corner attributes of a mesh, laid out for one gather per sample.

    Args:
        mesh: the mesh.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64.
        corners: (F, 3, C) float32: unit normal, then texture coordinates if textured, then colour if coloured.
        pyramid: textures (1, 3, h, w), each half the size of the one before; empty without a texture.
        texel_density: texels of the finest texture per mesh unit.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.vertices: Array64 = mesh.vertices.numpy().astype(np.float64)
        self.faces: NDArray[np.int64] = mesh.faces.numpy()
        self.hull: Array64 = mesh.hull_vertices.numpy().astype(np.float64)
        self.pyramid: list[Tensor] = []
        self.texel_density = 0.0
        columns = [_corner_normals(mesh)]
        if mesh.texture is not None and mesh.uv is not None:
            self.pyramid = _texture_pyramid(mesh.texture)
            self.texel_density = _texel_density(mesh.vertices, mesh.faces, mesh.uv, mesh.texture)
            columns.append(mesh.uv[mesh.faces])
        self.has_colors = mesh.vertex_colors is not None
        if mesh.vertex_colors is not None:
            columns.append(mesh.vertex_colors[mesh.faces])
        self.corners: Array32 = torch.cat(columns, dim=-1).numpy()

    def normals_and_albedo(self, hits: Hits, sample_spacing: float) -> tuple[Array32, Array32 | float]:
        """Model-frame normals (M, 3), not normalised, and colours (M, 3) before light.

        Args:
            hits: the samples.
            sample_spacing: distance of neighbouring samples on the surface, mesh units: picks the texture's
                level, so that a texture finer than the samples is averaged, not aliased.
        """
        values = interpolate(self.corners, hits)
        albedo: Array32 | float = PLAIN_ALBEDO
        if self.has_colors:
            albedo = values[:, -3:]
        if self.pyramid:
            level = round(float(np.log2(max(self.texel_density * sample_spacing, 1.0))))
            texels = sample_texture(self.pyramid[min(level, len(self.pyramid) - 1)], values[:, 3:5])
            albedo = texels * albedo if self.has_colors else texels
        return values[:, :3], albedo


surface_of = once_per_mesh(Surface)
"""A mesh's :class:`Surface`."""


def interpolate(corners: NDArray[np.floating], hits: Hits) -> NDArray[np.floating]:
    """Barycentric interpolation of per-corner values (F, 3, C) at M samples → (M, C)."""
    values = np.take(corners, hits.face, axis=0)
    return np.matmul(hits.weights[:, None, :], values)[:, 0]


def light(albedo: Array32 | float, normals: Array32, camera_axis: Array64, ambient: float) -> Array32:
    """Colours (M, 3) under ambient light and a lamp that shines along the camera's axis, on both sides alike.

    Args:
        albedo: (M, 3) or a grey level.
        normals: (M, 3) model frame, any length.
        camera_axis: (3,) the covector that takes a model-frame normal to its z in the camera frame.
        ambient: share of ambient light.
    """
    length = np.sqrt(np.einsum("mi,mi->m", normals, normals))
    cosine = np.abs(normals @ camera_axis.astype(np.float32)) / np.maximum(length, 1e-12)
    return albedo * (ambient + (1.0 - ambient) * cosine)[:, None]


def sample_texture(texture: Tensor, uv: Array32) -> Array32:
    """Bilinear lookup: (1, 3, h, w) at (M, 2), v up → (M, 3). Coordinates outside [0, 1] repeat the texture."""
    inside = np.where((uv < 0.0) | (uv > 1.0), uv - np.floor(uv), uv)
    grid = torch.from_numpy(inside * np.array([2.0, -2.0], np.float32) + np.array([-1.0, 1.0], np.float32))
    texels = F.grid_sample(
        texture, grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return texels[0, :, 0].T.numpy()


def _corner_normals(mesh: Mesh) -> Tensor:
    """(F, 3, 3) vertex normals where the surface is smooth, face normals at creases."""
    triangles = mesh.vertices.double()[mesh.faces]
    face = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    face = F.normalize(face, dim=-1, eps=1e-300).float()[:, None].expand(-1, 3, 3)
    vertex = mesh.vertex_normals[mesh.faces]
    smooth = (face * vertex).sum(-1, keepdim=True) > CREASE_COSINE
    return torch.where(smooth, vertex, face)


def _texture_pyramid(texture: Tensor) -> list[Tensor]:
    levels = [texture[None]]
    while min(levels[-1].shape[-2:]) > 1:
        height, width = levels[-1].shape[-2:]
        levels.append(F.interpolate(levels[-1], size=(height // 2, width // 2), mode="area"))
    return levels


def _texel_density(vertices: Tensor, faces: Tensor, uv: Tensor, texture: Tensor) -> float:
    triangles = vertices.double()[faces]
    sides = triangles[:, 1:] - triangles[:, :1]
    area = torch.linalg.vector_norm(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=-1).sum()
    texels = uv.double()[faces] * torch.tensor([texture.shape[2], texture.shape[1]])
    uv_sides = texels[:, 1:] - texels[:, :1]
    return float((torch.linalg.det(uv_sides).abs().sum() / area).sqrt())

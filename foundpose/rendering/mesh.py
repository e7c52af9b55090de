"""Triangle meshes with colours or a texture: checks, size."""

import hashlib
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
import trimesh.convex
from numpy.typing import NDArray
from torch import Tensor

T = TypeVar("T")

PLAIN_ALBEDO = 0.75
"""Grey level of surfaces for which there are neither colours nor a texture."""

# Single precision keeps a millionth of an object's size up to here.
_MOST_DISTANT = 100.0


class MeshError(ValueError):
    """A mesh that cannot be used, with the reason."""


class Mesh:
    """A triangle mesh; treat it as immutable.

    The surface colour is ``texture(uv) * vertex_colors``, whichever of the two is given; a mesh with neither
    is rendered light grey. All lengths are in mesh units, and poses estimated with the mesh come out in them.

    Args:
        vertices: (V, 3) in the model frame.
        faces: (F, 3) vertex indices.
        vertex_colors: (V, 3) in [0, 1].
        uv: (V, 2) texture coordinates with v up: (0, 0) is the lower left corner of the texture.
        texture: (3, h, w) in [0, 1], first row on top. Needs ``uv``.
        vertex_normals: (V, 3) for smooth shading, any length. Computed from the faces when absent.

    Raises:
        MeshError: empty mesh, wrong shapes, indices out of range, NaN or infinite vertices, no extent, far
            from its origin.

    Attributes are CPU tensors: float32, ``faces`` int64; ``vertex_normals`` have unit length.
    """

    def __init__(
        self,
        vertices: Tensor,
        faces: Tensor,
        vertex_colors: Tensor | None = None,
        uv: Tensor | None = None,
        texture: Tensor | None = None,
        vertex_normals: Tensor | None = None,
    ) -> None:
        check_geometry(vertices, faces)
        _check_appearance(len(vertices), vertex_colors, uv, texture, vertex_normals)
        self.vertices = _to_cpu(vertices)
        self.faces = faces.detach().to("cpu", torch.int64).contiguous()
        self.vertex_colors = None if vertex_colors is None else _to_cpu(vertex_colors)
        self.uv = None if uv is None else _to_cpu(uv)
        self.texture = None if texture is None else _to_cpu(texture)
        if vertex_normals is None:
            vertex_normals = area_weighted_normals(self.vertices, self.faces)
        self.vertex_normals = torch.nn.functional.normalize(_to_cpu(vertex_normals), dim=-1)

    def __repr__(self) -> str:
        colour = (
            "texture"
            if self.texture is not None
            else "colours"
            if self.vertex_colors is not None
            else "plain"
        )
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces, {colour})"

    @cached_property
    def checksum(self) -> str:
        """SHA-256 over geometry, normals, colours and texture; equal for equal content."""
        digest = hashlib.sha256()
        parts = [self.vertices, self.faces, self.vertex_normals, self.vertex_colors, self.uv, self.texture]
        for part in parts:
            if part is None:
                digest.update(b"none")
            else:
                array = part.numpy()
                digest.update(f"{array.shape}".encode())
                digest.update(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
        return digest.hexdigest()

    @cached_property
    def bounds(self) -> Tensor:
        """(2, 3) smallest and largest coordinates."""
        return torch.stack([self.vertices.amin(0), self.vertices.amax(0)])

    @cached_property
    def hull_vertices(self) -> Tensor:
        """(H, 3) vertices of the convex hull: whatever contains them contains the mesh."""
        return torch.from_numpy(_convex_hull(self.vertices.numpy()))

    @cached_property
    def diameter(self) -> float:
        """Largest distance between two vertices, mesh units."""
        hull = self.hull_vertices.double()
        radius = torch.linalg.vector_norm(hull - (hull.amin(0) + hull.amax(0)) / 2, dim=1)
        # The ends of the longest diagonal lie at least this far out.
        some = float(torch.linalg.vector_norm(hull - hull[radius.argmax()], dim=1).max())
        ends = hull[radius >= (some - radius.max()) * (1.0 - 1e-12)]
        # Differences, not dot products, which lose digits.
        exact = "donot_use_mm_for_euclid_dist"
        return max(float(torch.cdist(part, ends, compute_mode=exact).max()) for part in ends.split(256))


def once_per_mesh(build: Callable[[Mesh], T]) -> Callable[[Mesh], T]:
    """A function that builds something of a mesh on first use and keeps it for as long as the mesh lives."""
    kept: WeakKeyDictionary[Mesh, T] = WeakKeyDictionary()

    def of(mesh: Mesh) -> T:
        if mesh not in kept:
            kept[mesh] = build(mesh)
        return kept[mesh]

    return of


def area_weighted_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Vertex normals (V, 3), unit length: mean of the adjacent faces' normals weighted with their areas.

    Vertices at one place share a normal, so texture seams do not show in the shading.
    """
    triangles = vertices.double()[faces]
    doubled_areas = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    places, place = torch.unique(vertices, dim=0, return_inverse=True)
    sums = doubled_areas.new_zeros(len(places), 3)
    sums.index_add_(0, place[faces].reshape(-1), doubled_areas.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(sums, dim=-1, eps=1e-300)[place].to(vertices.dtype)


def _to_cpu(values: Tensor) -> Tensor:
    return values.detach().to("cpu", torch.float32).contiguous()


def check_geometry(vertices: Tensor, faces: Tensor) -> None:
    """Raise MeshError unless vertices (V, 3) and faces (F, 3) are a mesh that lies at its origin."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(
            f"vertices and faces must have shapes (V, 3) and (F, 3), got {tuple(vertices.shape)} and "
            f"{tuple(faces.shape)}"
        )
    if not len(vertices) or not len(faces):
        raise MeshError(f"the mesh is empty: {len(vertices)} vertices, {len(faces)} faces")
    bad = int((~torch.isfinite(vertices.float())).any(-1).sum())
    if bad:
        raise MeshError(f"{bad} of {len(vertices)} vertices have NaN or infinite coordinates")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise MeshError(
            f"faces refer to vertices {int(faces.min())} to {int(faces.max())}, but there are {len(vertices)}"
        )
    low, high = vertices.double().amin(0), vertices.double().amax(0)
    size, centre = float(torch.linalg.vector_norm(high - low)), (low + high) / 2
    if size == 0.0:
        raise MeshError("the mesh has no extent: all vertices are at one place")
    distance = float(torch.linalg.vector_norm(centre))
    if distance > _MOST_DISTANT * size:
        raise MeshError(
            f"the mesh lies {distance:.4g} from its origin, {distance / size:.3g} times its size of {size:.4g}, "
            f"where single precision would blur it and its poses by {distance * 6e-8:.2g}: subtract its centre "
            f"{[round(x, 4) for x in centre.tolist()]} from the vertices"
        )


def _check_appearance(
    count: int, colors: Tensor | None, uv: Tensor | None, texture: Tensor | None, normals: Tensor | None
) -> None:
    for name, value, width in (("vertex_colors", colors, 3), ("uv", uv, 2), ("vertex_normals", normals, 3)):
        if value is not None and tuple(value.shape) != (count, width):
            raise MeshError(f"{name} must have shape ({count}, {width}), got {tuple(value.shape)}")
        if value is not None and not bool(torch.isfinite(value).all()):
            raise MeshError(f"{name} contain NaN or infinite values")
    if texture is None:
        return
    if texture.ndim != 3 or texture.shape[0] != 3 or 0 in texture.shape:
        raise MeshError(f"texture must have shape (3, h, w), got {tuple(texture.shape)}")
    if uv is None:
        raise MeshError("a texture needs texture coordinates: uv is missing")


def _convex_hull(vertices: NDArray[np.float32]) -> NDArray[np.float32]:
    points = vertices.astype(np.float64)
    try:
        hull: NDArray[np.float64] = trimesh.convex.hull_points(points)
    except trimesh.convex.QhullError:
        # A flat mesh has no volume; its hull lies in the plane of its two main directions.
        centre = points.mean(0)
        axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
        hull = trimesh.convex.hull_points((points - centre) @ axes.T) @ axes + centre
    return hull.astype(np.float32)

"""Triangle meshes with colours or a texture: loading, checks, size."""

import hashlib
import warnings
from collections.abc import Callable
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
import trimesh.convex
from numpy.typing import NDArray
from torch import Tensor

from foundpose.rendering.mesh_io import MeshArrays, MeshError, read_mesh_file

__all__ = ["Mesh", "MeshError", "load_mesh", "warn_if_scale_implausible"]

T = TypeVar("T")

_PLAUSIBLE_DIAMETERS = (1e-3, 1e5)
_PLAUSIBLE_DISTANCES = (0.05, 500.0)  # camera distance in object diameters


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
        MeshError: empty mesh, wrong shapes, indices out of range, NaN or infinite vertices, no extent.

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
        _check_geometry(vertices, faces)
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


def load_mesh(path: str | PathLike[str]) -> Mesh:
    """Load a mesh with its colours or texture.

    PLY (vertex colours; texture named in a ``TextureFile`` comment, as in BOP), OBJ with its MTL file, GLB
    (nodes flattened; base colour texture and factor) and STL; other formats as far as trimesh reads them.
    Vertices without a face are dropped, and so are, with a warning, degenerate and duplicate faces. Normals
    are computed from the faces; those in the file are not used.

    Args:
        path: the file. Textures are looked for beside it.

    Returns:
        The mesh, lengths in the file's unit.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file cannot be parsed, has no faces, NaN or infinite vertices or no extent.
    """
    path = Path(path)
    arrays = read_mesh_file(path)
    try:
        _check_geometry(torch.from_numpy(arrays.vertices), torch.from_numpy(arrays.faces))
        arrays = _clean(arrays, path)
        mesh = Mesh(
            vertices=torch.from_numpy(arrays.vertices),
            faces=torch.from_numpy(arrays.faces),
            vertex_colors=None if arrays.colors is None else torch.from_numpy(arrays.colors),
            uv=None if arrays.uv is None else torch.from_numpy(arrays.uv),
            texture=None
            if arrays.texture is None
            else torch.from_numpy(arrays.texture.copy()).permute(2, 0, 1).float() / 255.0,
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    warn_if_scale_implausible(mesh)
    return mesh


def warn_if_scale_implausible(mesh: Mesh, distance: float | None = None) -> None:
    """Warn about a mesh whose size makes no sense, and name the unit that it is likely in.

    Nothing is rescaled: lengths stay in mesh units, and poses come out in the same units.

    Args:
        mesh: the mesh.
        distance: typical distance of the camera to the object, where known, in what is believed to be the
            mesh's unit. Without it only the diameter is judged, so metres and millimetres both pass.
    """
    diameter = mesh.diameter
    smallest, largest = _PLAUSIBLE_DIAMETERS
    if diameter < smallest:
        _warn(f"a mesh diameter of {diameter:.3g} is very small: is the mesh in kilometres, or scaled twice?")
    elif diameter > largest:
        _warn(
            f"a mesh diameter of {diameter:.3g} is very large: is the mesh in micrometres, or scaled twice?"
        )
    if distance is None:
        return
    ratio = distance / diameter
    if ratio > _PLAUSIBLE_DISTANCES[1]:
        _warn(
            f"the camera is {ratio:.3g} diameters away from the mesh: the mesh (diameter {diameter:.3g}) is "
            f"likely in metres and the camera distance ({distance:.3g}) in millimetres"
        )
    elif ratio < _PLAUSIBLE_DISTANCES[0]:
        _warn(
            f"the camera is only {ratio:.3g} diameters away from the mesh: the mesh (diameter {diameter:.3g}) "
            f"is likely in millimetres and the camera distance ({distance:.3g}) in metres"
        )


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


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=3)


def _check_geometry(vertices: Tensor, faces: Tensor) -> None:
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
    if float((vertices.amax(0) - vertices.amin(0)).max()) == 0.0:
        raise MeshError("the mesh has no extent: all vertices are at one place")


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


def _clean(arrays: MeshArrays, path: Path) -> MeshArrays:
    """Drop faces that are degenerate or there twice and vertices without a face; warn about what matters."""
    triangles = arrays.vertices[arrays.faces]
    doubled_area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    extent = float(np.ptp(arrays.vertices, axis=0).max())
    solid = doubled_area > 1e-14 * extent**2
    # Seams split vertices; topology is judged on places.
    place = np.unique(arrays.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    corners = np.sort(place[arrays.faces], axis=1)
    first = np.zeros(len(corners), bool)
    first[np.unique(corners, axis=0, return_index=True)[1]] = True
    keep = solid & first
    if not keep.any():
        raise MeshError(f"all {len(keep)} faces are degenerate (zero area)")
    if not keep.all():
        _warn_file(
            path,
            f"dropped {int((~solid).sum())} degenerate and {int((solid & ~first).sum())} duplicate faces",
        )
    corners = corners[keep]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])
    shared = np.unique(edges, axis=0, return_counts=True)[1]
    if (shared > 2).any():
        _warn_file(
            path,
            f"{int((shared > 2).sum())} of {len(shared)} edges are not manifold (more than two faces meet); it is "
            "rendered as it is, but may have inner walls or doubled surfaces",
        )
    used, faces = np.unique(arrays.faces[keep], return_inverse=True)
    return arrays._replace(
        vertices=arrays.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=None if arrays.colors is None else arrays.colors[used],
        uv=None if arrays.uv is None else arrays.uv[used],
    )


def _warn_file(path: Path, message: str) -> None:
    warnings.warn(f"mesh {path}: {message}", stacklevel=4)


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

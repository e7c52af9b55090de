"""Meshes from files."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from trimesh.visual.material import SimpleMaterial, pack

from foundpose.rendering.mesh import PLAIN_ALBEDO, Mesh, MeshError, check_geometry
from foundpose.rendering.mesh_colors import Array, MeshPart, read_parts
from foundpose.utils.warn import warn_caller

_PLAUSIBLE_DIAMETERS = (1e-3, 1e5)


def load_mesh(path: str | PathLike[str], color: Sequence[float] | None = None) -> Mesh:
    """Load a mesh with its colours or texture.

    PLY (colours of vertices or faces; texture named in a ``TextureFile`` comment, as in BOP), OBJ with its MTL file,
    GLB (nodes flattened; base colour texture and factor) and STL with its dialects of colour; other formats as far as
    trimesh reads them. Vertices without a face are dropped, and so are, with a warning, degenerate and duplicate
    faces. Normals are computed from the faces; those in the file are not used.

    Args:
        path: the file. Textures are looked for where it says, and beside it.
        color: [red, green, blue] in [0, 1] of surfaces for which the file gives no colour; None: light grey.

    Returns:
        The mesh, lengths in the file's unit.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file cannot be parsed, has no faces, NaN or infinite vertices or no extent, or lies far from
            its origin.
        ValueError: ``color`` is none.
    """
    path = Path(path).expanduser()
    part = read_mesh_file(path, color)
    try:
        check_geometry(torch.from_numpy(part.vertices), torch.from_numpy(part.faces))
        part = _clean(part, path)
        mesh = Mesh(
            vertices=torch.from_numpy(part.vertices),
            faces=torch.from_numpy(part.faces),
            vertex_colors=None if part.colors is None else torch.from_numpy(part.colors),
            uv=None if part.texture is None or part.uv is None else torch.from_numpy(part.uv),
            texture=None
            if part.texture is None
            else torch.from_numpy(part.texture.copy()).permute(2, 0, 1).float() / 255.0,
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    low, high = _PLAUSIBLE_DIAMETERS
    if not low <= mesh.diameter <= high:
        size, unit = ("small", "kilometres") if mesh.diameter < low else ("large", "micrometres")
        warn_caller(
            f"mesh {path}: a diameter of {mesh.diameter:.3g} is very {size}: is it in {unit}, or scaled twice?"
        )
    return mesh


def read_mesh_file(path: Path, color: Sequence[float] | None = None) -> MeshPart:
    """All parts of a mesh file as one, nothing cleaned; arguments and errors as of :func:`load_mesh`."""
    if color is not None:
        given = list(color) if isinstance(color, Sequence) else []
        numbers = [c for c in given if isinstance(c, int | float) and 0.0 <= c <= 1.0]
        if not len(given) == len(numbers) == 3:
            raise ValueError(f"color must be [red,green,blue] in [0, 1], got {color}")
    parts = read_parts(path)
    if color is not None or any(part.colors is not None for part in parts):
        plain = np.full(3, PLAIN_ALBEDO) if color is None else np.asarray(color, np.float64)
        parts = [_with_colors(part, plain) for part in parts]
    return parts[0] if len(parts) == 1 else _merge(parts)


def _with_colors(part: MeshPart, plain: Array) -> MeshPart:
    """A part with a colour at every vertex: white below a texture, ``plain`` where the file gives none."""
    colors = part.colors
    if colors is None:
        colors = np.tile(plain if part.texture is None else np.ones(3), (len(part.vertices), 1))
    return part._replace(colors=np.where(np.isnan(colors), plain, colors))


def _merge(parts: Sequence[MeshPart]) -> MeshPart:
    """Concatenate; several textures are packed into one image (coordinates outside [0, 1] are wrapped)."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    merged = MeshPart(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
    )
    textured = any(part.texture is not None for part in parts)
    if textured and not all(part.texture is not None for part in parts):
        parts = [_with_colors(part, np.full(3, PLAIN_ALBEDO)) for part in parts]
    colors = [part.colors for part in parts if part.colors is not None]
    if colors:
        merged = merged._replace(colors=np.concatenate(colors))
    if textured:
        white = np.full((4, 4, 3), 255, np.uint8)
        images = [white if part.texture is None else part.texture for part in parts]
        uvs = [
            np.full((len(p.vertices), 2), 0.5) if p.uv is None or p.texture is None else p.uv for p in parts
        ]
        material, uv = pack([SimpleMaterial(image=Image.fromarray(image)) for image in images], uvs)
        texture = np.asarray(material.image.convert("RGB"), np.uint8)
        merged = merged._replace(uv=np.asarray(uv, np.float64), texture=texture)
    return merged


def _clean(part: MeshPart, path: Path) -> MeshPart:
    """Drop faces that are degenerate or there twice and vertices without a face; warn about what matters."""
    triangles = part.vertices[part.faces]
    doubled_area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    extent = float(np.ptp(part.vertices, axis=0).max())
    solid = doubled_area > 1e-14 * extent**2
    # Seams split vertices; topology is judged on places.
    place = np.unique(part.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    corners = np.sort(place[part.faces], axis=1)
    first = np.zeros(len(corners), bool)
    first[np.unique(corners, axis=0, return_index=True)[1]] = True
    keep = solid & first
    if not keep.any():
        raise MeshError(f"all {len(keep)} faces are degenerate (zero area)")
    if not keep.all():
        warn_caller(
            f"mesh {path}: dropped {int((~solid).sum())} degenerate and {int((solid & ~first).sum())} duplicate faces"
        )
    corners = corners[keep]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])
    shared = np.unique(edges, axis=0, return_counts=True)[1]
    if (shared > 2).any():
        warn_caller(
            f"mesh {path}: {int((shared > 2).sum())} of {len(shared)} edges are not manifold (more than two faces "
            "meet); it is rendered as it is, but may have inner walls or doubled surfaces"
        )
    used, faces = np.unique(part.faces[keep], return_inverse=True)
    return part._replace(
        vertices=part.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=None if part.colors is None else part.colors[used],
        uv=None if part.uv is None else part.uv[used],
    )

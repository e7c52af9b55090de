"""Reading mesh files: every format that trimesh reads becomes one set of plain arrays."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial, pack

PLAIN_ALBEDO = 0.75
"""Grey level of surfaces for which a file gives neither colours nor a texture."""

Array = NDArray[np.float64]


class MeshError(ValueError):
    """A mesh that cannot be used, with the reason."""


class MeshArrays(NamedTuple):
    """Geometry and appearance as stored in a file.

    Attributes:
        vertices: (V, 3) in the file's length unit.
        faces: (F, 3) vertex indices.
        colors: (V, 3) in [0, 1] or None.
        uv: (V, 2) texture coordinates, v up (0 is the bottom row of the texture), or None.
        texture: (h, w, 3) uint8, first row on top, or None.
    """

    vertices: Array
    faces: NDArray[np.int64]
    colors: Array | None = None
    uv: Array | None = None
    texture: NDArray[np.uint8] | None = None


def read_mesh_file(path: Path) -> MeshArrays:
    """Read a mesh file, its materials and textures; scenes are flattened with their node transforms.

    Args:
        path: PLY, OBJ, GLB, glTF, STL or any other format known to trimesh.

    Returns:
        Arrays as they stand in the file, nothing cleaned.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: it cannot be parsed or has no triangles.
    """
    if not path.is_file():
        raise FileNotFoundError(f"mesh file {path} does not exist")
    try:
        # process=False: merging vertices would renumber them and smear colours over texture seams.
        scene = trimesh.load_scene(path, process=False)
        parts = [_read_part(g, path) for g in scene.dump() if isinstance(g, trimesh.Trimesh)]
    except Exception as error:  # each of trimesh's parsers raises errors of its own
        raise MeshError(
            f"{path} cannot be read as a mesh ({type(error).__name__}: {error}); is the file complete and of "
            f"the format that its suffix {path.suffix!r} says?"
        ) from error
    parts = [part for part in parts if len(part.faces) and len(part.vertices)]
    if not parts:
        raise MeshError(f"{path} contains no triangles; a surface mesh is needed, not a point cloud")
    return parts[0] if len(parts) == 1 else _merge(parts)


def _read_part(geometry: trimesh.Trimesh, path: Path) -> MeshArrays:
    part = MeshArrays(np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces, np.int64))
    visual = geometry.visual
    if isinstance(visual, trimesh.visual.TextureVisuals):
        return _read_texture(part, visual, path)
    if visual.kind == "vertex":
        return part._replace(colors=_unit_rgb(visual.vertex_colors))
    if visual.kind == "face":
        # A vertex has one colour, so faces of different colours cannot share it.
        return MeshArrays(
            vertices=part.vertices[part.faces.reshape(-1)],
            faces=np.arange(part.faces.size).reshape(-1, 3),
            colors=np.repeat(_unit_rgb(visual.face_colors), 3, axis=0),
        )
    return part


def _read_texture(part: MeshArrays, visual: trimesh.visual.TextureVisuals, path: Path) -> MeshArrays:
    material, uv = visual.material, visual.uv
    has_uv = uv is not None and len(uv) == len(part.vertices)
    colors: Array | None
    if isinstance(material, PBRMaterial):
        image, factor = material.baseColorTexture, material.baseColorFactor
        # glTF multiplies texture, factor and vertex colours.
        colors = np.ones((len(part.vertices), 3)) if factor is None else _broadcast_color(factor, part)
        if "color" in visual.vertex_attributes:
            colors = colors * _unit_rgb(visual.vertex_attributes["color"])
        plain = factor is None and "color" not in visual.vertex_attributes
    else:
        image = getattr(material, "image", None)
        # An OBJ's Kd beside a map is usually an exporter's default (often 0), so the map alone counts.
        plain = image is not None or material is None
        colors = None if plain else _broadcast_color(material.main_color, part)
        if has_uv and image is None:
            warnings.warn(
                f"{path} has texture coordinates but its texture image was not found; the surface gets a plain "
                "colour. Keep the texture (and the .mtl file) beside the mesh under the name that it refers to",
                stacklevel=4,
            )
    if image is not None and has_uv:
        texture = np.asarray(image.convert("RGB"), np.uint8)
        return part._replace(colors=None if plain else colors, uv=np.asarray(uv, np.float64), texture=texture)
    return part._replace(colors=None if plain else colors)


def _broadcast_color(color: NDArray[np.uint8], part: MeshArrays) -> Array:
    return np.tile(_unit_rgb(np.asarray(color)[None]), (len(part.vertices), 1))


def _unit_rgb(colors: NDArray[Any]) -> Array:
    colors = np.asarray(colors)
    scale = float(np.iinfo(colors.dtype).max) if colors.dtype.kind in "iu" else 1.0
    return colors[:, :3].astype(np.float64) / scale


def _merge(parts: list[MeshArrays]) -> MeshArrays:
    """Concatenate; several textures are packed into one image (coordinates outside [0, 1] are wrapped)."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    merged = MeshArrays(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
    )
    if any(part.colors is not None or part.texture is not None for part in parts):
        merged = merged._replace(colors=np.concatenate([_explicit_colors(part) for part in parts]))
    if any(part.texture is not None for part in parts):
        white = np.full((4, 4, 3), 255, np.uint8)
        images = [white if part.texture is None else part.texture for part in parts]
        uvs = [np.full((len(p.vertices), 2), 0.5) if p.uv is None else p.uv for p in parts]
        material, uv = pack([SimpleMaterial(image=Image.fromarray(image)) for image in images], uvs)
        texture = np.asarray(material.image.convert("RGB"), np.uint8)
        merged = merged._replace(uv=np.asarray(uv, np.float64), texture=texture)
    return merged


def _explicit_colors(part: MeshArrays) -> Array:
    if part.colors is not None:
        return part.colors
    return np.full((len(part.vertices), 3), 1.0 if part.texture is not None else PLAIN_ALBEDO)

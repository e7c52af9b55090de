"""What mesh files say of colours, as a viewer shows it: textures, materials, colours of vertices and faces."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply
from trimesh.resolvers import FilePathResolver
from trimesh.visual.color import linear_to_srgb
from trimesh.visual.material import PBRMaterial

from foundpose.rendering.mesh import MeshError
from foundpose.utils.pictures import PictureError, convert_picture, read_picture
from foundpose.utils.warn import warn_caller

Array = NDArray[np.float64]


class MeshPart(NamedTuple):
    """Triangles with one kind of appearance.

    Attributes:
        vertices: (V, 3) in the file's length unit.
        faces: (F, 3) vertex indices.
        colors: (V, 3) in [0, 1], NaN where the file gives none; None where it gives none at all.
        uv: (V, 2) texture coordinates, v up (0 is the bottom row of the texture), or None.
        texture: (h, w, 3) uint8, first row on top, or None.
    """

    vertices: Array
    faces: NDArray[np.int64]
    colors: Array | None = None
    uv: Array | None = None
    texture: NDArray[np.uint8] | None = None


class Assets(FilePathResolver):
    """Finds the files that a mesh refers to, however another system wrote their names; textures become RGB.

    Attributes:
        faults: what was not found or is no picture, in words.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path), allow_anywhere=True)
        self.folder = path.resolve().parent
        self.faults: list[str] = []

    def get(self, name: str) -> bytes:
        """Content of a file; of a picture, upright and in RGB."""
        name = _without_options(name)
        try:
            path = self._find(name)
            if path.suffix.lower() in (".mtl", ".bin"):
                return path.read_bytes()
            rgb = (read_picture(path).rgb.permute(1, 2, 0) * 255.0).round().byte().numpy()
        except (FileNotFoundError, PictureError) as error:
            kind = "material file" if name.lower().endswith(".mtl") else "texture image"
            lost = isinstance(error, FileNotFoundError)
            self.faults.append(f"its {kind} {'was not found' if lost else 'cannot be read'}: {error}")
            raise
        stream = BytesIO()
        Image.fromarray(rgb).save(stream, "BMP")
        return stream.getvalue()

    def _find(self, name: str) -> Path:
        """A file by its name, by its name beside the mesh, or by that in other letters."""
        plain = name.replace("\\", "/")
        base = plain.rsplit("/", 1)[-1]
        for candidate in (self.folder / name, self.folder / plain, self.folder / base):
            if candidate.is_file():
                return candidate
        for candidate in self.folder.iterdir():
            if candidate.name.lower() == base.lower() and candidate.is_file():
                return candidate
        raise FileNotFoundError(f"there is no {name} beside it")


def _without_options(text: str) -> str:
    """The name in a line as ``-s 1 1 1 -clamp on "my texture.png"`` of an MTL file."""
    numbers = r"(?:\s+-?[\d.]+(?:[eE][-+]?\d+)?(?=\s))"
    options = rf"-(?:(?:o|s|t|mm){numbers}{{1,3}}|[a-z]+\s+\S+)\s+"
    while match := re.match(options, text):
        text = text[match.end() :]
    return text.strip().strip("\"'")


def read_parts(path: Path) -> list[MeshPart]:
    """Read a mesh file, its materials and textures; scenes are flattened with their node transforms.

    Args:
        path: PLY, OBJ, GLB, glTF, STL or any other format known to trimesh.

    Returns:
        Parts as they stand in the file, nothing cleaned.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: it cannot be parsed or has no triangles.
    """
    if not path.is_file():
        raise FileNotFoundError(f"mesh file {path} does not exist")
    assets = Assets(path)
    readers: dict[str, Callable[[Path, Assets], Iterator[MeshPart]]] = {".ply": _read_ply, ".obj": _read_obj}
    try:
        parts = list(readers.get(path.suffix.lower(), _read_scene)(path, assets))
    except Exception as error:  # each of trimesh's parsers raises errors of its own
        reason = "; ".join(assets.faults) or f"{type(error).__name__}: {error}"
        raise MeshError(
            f"{path} cannot be read as a mesh ({reason}); is the file complete and of the format that its suffix "
            f"{path.suffix!r} says?"
        ) from error
    parts = [part for part in parts if len(part.faces) and len(part.vertices)]
    if not parts:
        raise MeshError(f"{path} contains no triangles; a surface mesh is needed, not a point cloud")
    faults = list(dict.fromkeys(assets.faults))
    if not faults and all(part.colors is None and part.texture is None for part in parts):
        faults = ["it has texture coordinates but names no texture"] * any(p.uv is not None for p in parts)
    for fault in faults:
        warn_caller(
            f"mesh {path}: {fault}; the surface gets a plain colour. Keep textures and the .mtl file beside the mesh "
            "under the names that it refers to, or give a colour"
        )
    return parts


def _read_ply(path: Path, assets: Assets) -> Iterator[MeshPart]:
    with path.open("rb") as file:
        loaded = load_ply(file, resolver=assets)
    visual = loaded.get("visual")
    image = None if visual is None else _from_file(visual.material.image)
    if image is not None:
        faces, _ = _triangles(loaded["faces"])
        yield MeshPart(_vertices(loaded), faces, uv=np.asarray(visual.uv, np.float64), texture=_texels(image))
        return
    with path.open("rb") as file:  # once more, with the vertices that the colours belong to
        loaded = load_ply(file, fix_texture=False, skip_materials=True)
    if loaded.get("faces") is None:
        return
    raw = loaded["metadata"]["_ply_raw"]
    of_vertices, of_faces = _ply_colors(raw["vertex"]), _ply_colors(raw["face"])
    polygons = loaded["faces"]
    if of_faces is not None and len(of_faces) != len(polygons):  # polygons of several sizes
        data = raw["face"]["data"]
        polygons = data["vertex_indices" if "vertex_indices" in data else "vertex_index"]
    faces, polygon = _triangles(polygons)
    uv = None if visual is None else np.zeros((len(loaded["vertices"]), 2))
    part = MeshPart(_vertices(loaded), faces, of_vertices, uv)
    yield part if of_vertices is not None or of_faces is None else _by_face(part, of_faces[polygon])


def _read_obj(path: Path, assets: Assets) -> Iterator[MeshPart]:
    with path.open("rb") as file:
        loaded = load_obj(file, resolver=assets)
    for geometry in loaded.get("geometry", {}).values():
        visual = geometry.get("visual")
        material, uv = (None, None) if visual is None else (visual.material, visual.uv)
        part = MeshPart(_vertices(geometry), _triangles(geometry["faces"])[0], uv=_matching(uv, geometry))
        image = _from_file(getattr(material, "image", None))
        kd: Any = getattr(material, "kwargs", {}).get("kd")
        if image is not None and part.uv is not None:
            # Kd beside a map is usually an exporter's default, often 0, so the map alone counts.
            yield part._replace(texture=_texels(image))
        elif geometry.get("vertex_colors") is not None:
            yield part._replace(colors=_unit_rgb(geometry["vertex_colors"]))
        elif np.size(kd) == 3 and (any(kd) or not assets.faults):
            yield part._replace(
                colors=np.tile(np.clip(np.asarray(kd, np.float64), 0, 1), (len(part.vertices), 1))
            )
        else:
            yield part


def _read_scene(path: Path, assets: Assets) -> Iterator[MeshPart]:
    # process=False: merging vertices would renumber them and smear colours over texture seams.
    scene = trimesh.load_scene(path, process=False, resolver=assets)
    # Factors and colours of glTF are light, not its encoding as on a screen.
    encode: Callable[[Array], Array] = (
        linear_to_srgb if path.suffix.lower() in (".glb", ".gltf") else np.asarray
    )
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh):
            continue
        vertices = trimesh.transform_points(geometry.vertices, transform)
        part = MeshPart(vertices, np.asarray(geometry.faces, np.int64))
        visual = geometry.visual
        if isinstance(visual, trimesh.visual.TextureVisuals):
            yield _read_material(part, visual, encode)
        elif visual.kind == "vertex":
            yield part._replace(colors=encode(_unit_rgb(visual.vertex_colors)))
        elif visual.kind == "face":
            yield _by_face(part, _unit_rgb(visual.face_colors))
        elif "stl" in geometry.face_attributes:
            colors = _stl_colors(path, geometry.face_attributes["stl"])
            yield part if colors is None else _by_face(part, colors)
        else:
            yield part


def _read_material(
    part: MeshPart, visual: trimesh.visual.TextureVisuals, encode: Callable[[Array], Array]
) -> MeshPart:
    material, uv = visual.material, visual.uv
    part = part._replace(
        uv=None if uv is None or len(uv) != len(part.vertices) else np.asarray(uv, np.float64)
    )
    pbr = isinstance(material, PBRMaterial)
    image = _from_file(material.baseColorTexture if pbr else getattr(material, "image", None))
    factor = material.baseColorFactor if pbr else None if material is None or image else material.main_color
    # Texture, factor and colours of vertices are multiplied.
    colors = None
    if factor is not None:
        colors = np.tile(encode(_unit_rgb(np.asarray(factor)[None])), (len(part.vertices), 1))
    if "color" in visual.vertex_attributes:
        own = encode(_unit_rgb(visual.vertex_attributes["color"]))
        colors = own if colors is None else own * colors
    if image is not None and part.uv is not None:
        return part._replace(colors=colors, texture=_texels(image))
    return part._replace(colors=colors)


def _from_file(image: Image.Image | None) -> Image.Image | None:
    """A material's image unless it is trimesh's own, which stands in where there is none."""
    return None if image is None or image.format is None else image


def _texels(image: Image.Image) -> NDArray[np.uint8]:
    rgb = convert_picture(image, "its texture image").rgb
    return (rgb.permute(1, 2, 0) * 255.0).round().byte().numpy()


def _vertices(loaded: Mapping[str, Any]) -> Array:
    return np.asarray(loaded["vertices"], np.float64)


def _matching(uv: Any, geometry: Mapping[str, Any]) -> Array | None:
    return None if uv is None or len(uv) != len(geometry["vertices"]) else np.asarray(uv, np.float64)[:, :2]


def _triangles(polygons: Sequence[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Polygons cut into fans: triangles (F, 3) and the polygon (F,) of each."""
    if isinstance(polygons, np.ndarray) and polygons.ndim == 2:
        count = polygons.shape[1] - 2
        fans = np.stack([polygons[:, [0, i, i + 1]] for i in range(1, count + 1)], axis=1)
        return fans.reshape(-1, 3).astype(np.int64), np.repeat(np.arange(len(polygons)), count)
    fans = [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]
    sizes = [max(len(p) - 2, 0) for p in polygons]
    return np.asarray(fans, np.int64).reshape(-1, 3), np.repeat(np.arange(len(sizes)), sizes)


def _by_face(part: MeshPart, colors: Array) -> MeshPart:
    """A part whose faces (F, 3) have colours: a vertex has one colour, so they cannot share it."""
    faces = np.arange(part.faces.size).reshape(-1, 3)
    return MeshPart(part.vertices[part.faces.reshape(-1)], faces, np.repeat(colors, 3, axis=0))


def _unit_rgb(colors: Any) -> Array:
    """Colours (N, 3 or 4) as (N, 3) in [0, 1]: whole numbers by their range, others by 255 if any is above 1."""
    array = np.asarray(colors)
    values = array[:, :3].astype(np.float64)
    if array.dtype.kind in "iu":
        values /= 255.0 if array.dtype.itemsize > 2 else np.iinfo(array.dtype).max
    elif np.nanmax(values, initial=0.0) > 1.0:
        values /= 255.0
    return values.clip(0.0, 1.0)


def _ply_colors(element: Mapping[str, Any]) -> Array | None:
    """Colours of a PLY file's vertices or faces, under any of the names in use."""
    for prefix in ("", "diffuse_"):
        for names in (("red", "green", "blue"), ("r", "g", "b")):
            keys = [prefix + name for name in names]
            if all(key in element["properties"] for key in keys):
                return _unit_rgb(np.stack([np.asarray(element["data"][k]).reshape(-1) for k in keys], axis=1))
    return None


def _stl_colors(path: Path, attributes: NDArray[np.uint16]) -> Array | None:
    """Colours of a binary STL's faces (F, 3), NaN where a face has none, from the two bytes that STL leaves free."""
    bits = np.asarray(attributes).reshape(-1).astype(np.int64)
    low, middle, high = ((bits >> shift & 31) / 31.0 for shift in (0, 5, 10))
    flag = (bits >> 15 == 1)[:, None]
    with path.open("rb") as file:
        header = file.read(80)
    at = header.find(b"COLOR=")
    if at >= 0 and len(header) >= at + 9:  # Materialise Magics; flagged faces have the colour of the whole
        whole = np.frombuffer(header[at + 6 : at + 9], np.uint8) / 255.0
        return np.where(flag, whole, np.stack([low, middle, high], axis=1))
    if flag.any():  # VisCAM and SolidView; flagged faces have a colour
        return np.where(flag, np.stack([high, middle, low], axis=1), np.nan)
    return None

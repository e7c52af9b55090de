"""Mesh files of all kinds: the colour that a viewer shows, or a message that says what is wrong."""

import json
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual.color import linear_to_srgb

from foundpose.evaluation.objects import DatasetObjects
from foundpose.geometry import intrinsics_matrix
from foundpose.rendering import Mesh, MeshError, RaycastRenderer, load_mesh

RED, GREEN, BLUE, ORANGE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 128 / 255, 0.0)
GREY = (0.75, 0.75, 0.75)
CORNERS = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]
UV = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
FACES = [(0, 1, 2), (0, 2, 3)]
K = intrinsics_matrix(200.0, 200.0, 31.5, 31.5)[None]


def shown(mesh: Mesh) -> list[tuple[float, ...]]:
    """Colours of the square's upper right and lower left half in a picture of it."""
    T = torch.eye(4)[None]
    T[:, 2, 3] = 10.0
    rgb = RaycastRenderer(ambient=1.0)(mesh, T, K, (64, 64)).rgb[0]
    return [tuple(rgb[:, v, u].tolist()) for v, u in ((22, 42), (42, 22))]


def picture(path: Path, color: tuple[float, ...] = ORANGE, **save: object) -> Path:
    Image.new("RGB", (8, 8), tuple(round(255 * c) for c in color)).save(path, **save)
    return path


def ply(path: Path, of_vertices: list[str], of_faces: list[str] = (), polygons=FACES, head: str = "") -> Path:
    """A square; each property is ``type name value…``, the same value everywhere or one for each."""

    def column(text: str, i: int) -> str:
        values = text.split()[2:]
        return values[i % len(values)]

    lines = ["ply", "format ascii 1.0", *([head] if head else []), "element vertex 4"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["property " + " ".join(p.split()[:2]) for p in of_vertices]
    lines += [f"element face {len(polygons)}", "property list uchar int vertex_indices"]
    lines += ["property " + " ".join(p.split()[:2]) for p in of_faces]
    lines += ["end_header"]
    for i, corner in enumerate(CORNERS):
        lines.append(" ".join([*map(str, corner), *(column(p, i) for p in of_vertices)]))
    for i, polygon in enumerate(polygons):
        lines.append(" ".join([str(len(polygon)), *map(str, polygon), *(column(p, i) for p in of_faces)]))
    path.write_text("\n".join(lines) + "\n")
    return path


UV_PLY = ["float texture_u 0 1 1 0", "float texture_v 1 1 0 0"]
UCHAR = ["uchar red 255", "uchar green 128", "uchar blue 0"]


def with_texture(folder: Path, colors: list[str]) -> Path:
    picture(folder / "my texture.png")
    return ply(folder / "a.ply", UV_PLY + colors, head="comment TextureFile my texture.png")


def obj(
    folder: Path, mtl: str | None, line: str = "mtllib a.mtl", body: str | None = None, **changes
) -> Path:
    """A square whose two halves use the materials ``a`` and, if the MTL file has it, ``b``."""
    (folder / "a.mtl").write_text(mtl) if mtl is not None else None
    second = "usemtl b" if mtl is not None and "newmtl b" in mtl else ""
    extra = changes.get("extra", "")
    lines = [line, *(f"v {x} {y} {z} {extra}" for x, y, z in CORNERS), *(f"vt {u} {v}" for u, v in UV)]
    lines += ["usemtl a", "f 1/1 2/2 3/3", second, "f 1/1 3/3 4/4"] if body is None else [body]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    return folder / "a.obj"


def glb(folder: Path, material: dict | None, colors: np.ndarray | None = None) -> Path:
    """The square as GLB, written by hand so that nothing is converted."""
    blobs = [np.float32(CORNERS).tobytes(), np.uint16(FACES).tobytes()]
    accessors = [
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": 4,
            "type": "VEC3",
            "min": [-1, -1, 0],
            "max": [1, 1, 0],
        },
        {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    attributes, primitive = {"POSITION": 0}, {}
    if colors is not None:
        kind = {"float32": 5126, "uint8": 5121, "uint16": 5123}[str(colors.dtype)]
        blobs.append(colors.tobytes())
        accessors.append(
            {"bufferView": 2, "componentType": kind, "count": 4, "type": f"VEC{colors.shape[1]}"}
            | ({} if kind == 5126 else {"normalized": True})
        )
        attributes["COLOR_0"] = 2
    if material is not None:
        primitive["material"] = 0
    views, offset, data = [], 0, b""
    for blob in blobs:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob)})
        data += blob + bytes(-len(blob) % 4)
        offset = len(data)
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, **primitive}]}],
        "materials": [] if material is None else [{"pbrMetallicRoughness": material}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    )
    path = folder / "a.glb"
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


def stl(folder: Path, attributes: list[int], header: bytes = b"") -> Path:
    data = header.ljust(80) + struct.pack("<I", 2)
    for face, attribute in zip(FACES, attributes, strict=True):
        data += struct.pack("<12fH", 0, 0, -1, *(x for i in face for x in CORNERS[i]), attribute)
    path = folder / "a.stl"
    path.write_bytes(data)
    return path


def bits(high: int, middle: int, low: int, flag: int) -> int:
    return flag << 15 | high << 10 | middle << 5 | low


class Case(NamedTuple):
    kind: str
    make: Callable[[Path], Path]
    colors: tuple[tuple[float, ...], tuple[float, ...]]
    warning: str | None = None


def both(color: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return color, color


def srgb(*values: float) -> tuple[float, ...]:
    return tuple(linear_to_srgb(np.array(values)).tolist())


MAP = "newmtl a\nKd 0 0 0\nmap_Kd "
CASES = [
    Case("PLY: nothing", lambda p: ply(p / "a.ply", []), both(GREY)),
    Case("PLY: uchar at vertices", lambda p: ply(p / "a.ply", UCHAR), both(ORANGE)),
    Case("PLY: uchar with alpha", lambda p: ply(p / "a.ply", [*UCHAR, "uchar alpha 7"]), both(ORANGE)),
    Case(
        "PLY: ushort",
        lambda p: ply(p / "a.ply", ["ushort red 65535", "ushort green 32896", "ushort blue 0"]),
        both(ORANGE),
    ),
    Case(
        "PLY: float up to 1",
        lambda p: ply(p / "a.ply", ["float red 1", "float green 0.50196", "float blue 0"]),
        both(ORANGE),
    ),
    Case(
        "PLY: float up to 255",
        lambda p: ply(p / "a.ply", ["float red 255", "float green 128", "float blue 0"]),
        both(ORANGE),
    ),
    Case(
        "PLY: int up to 255",
        lambda p: ply(p / "a.ply", ["int red 255", "int green 128", "int blue 0"]),
        both(ORANGE),
    ),
    Case(
        "PLY: diffuse_red",
        lambda p: ply(
            p / "a.ply", ["uchar diffuse_red 255", "uchar diffuse_green 128", "uchar diffuse_blue 0"]
        ),
        both(ORANGE),
    ),
    Case("PLY: r g b", lambda p: ply(p / "a.ply", ["uchar r 255", "uchar g 128", "uchar b 0"]), both(ORANGE)),
    Case(
        "PLY: at faces",
        lambda p: ply(p / "a.ply", [], ["uchar red 255 0", "uchar green 0", "uchar blue 0 255"]),
        (RED, BLUE),
    ),
    Case(
        "PLY: at faces, a quadrilateral",
        lambda p: ply(p / "a.ply", [], ["uchar red 0", "uchar green 255", "uchar blue 0"], [(0, 1, 2, 3)]),
        both(GREEN),
    ),
    Case(
        "PLY: at faces, polygons of several sizes",
        lambda p: ply(
            p / "a.ply",
            [],
            ["uchar red 255 0", "uchar green 0 255", "uchar blue 0 0"],
            [(0, 1, 2, 3), (0, 1, 2)],
        ),
        both(RED),
        "duplicate",
    ),
    Case(
        "PLY: texture and colours",
        lambda p: with_texture(p, ["uchar red 0", "uchar green 0", "uchar blue 9"]),
        both(ORANGE),
    ),
    Case(
        "PLY: texture coordinates and colours, no texture",
        lambda p: ply(p / "a.ply", UV_PLY + UCHAR),
        both(ORANGE),
    ),
    Case(
        "PLY: texture that is missing, colours",
        lambda p: ply(p / "a.ply", UV_PLY + UCHAR, head="comment TextureFile lost.png"),
        both(ORANGE),
        "texture image was not found: there is no lost.png",
    ),
    Case(
        "PLY: texture coordinates alone", lambda p: ply(p / "a.ply", UV_PLY), both(GREY), "names no texture"
    ),
    Case("OBJ: Kd", lambda p: obj(p, "newmtl a\nKd 1 0.50196 0\n"), both(ORANGE)),
    Case("OBJ: colours at vertices", lambda p: obj(p, None, "", extra="1 0.50196 0"), both(ORANGE)),
    Case("OBJ: colours at vertices up to 255", lambda p: obj(p, None, "", extra="255 128 0"), both(ORANGE)),
    Case("OBJ: map_Kd", lambda p: (picture(p / "t.png"), obj(p, MAP + "t.png"))[1], both(ORANGE)),
    Case(
        "OBJ: spaces in the name",
        lambda p: (picture(p / "a b c.png"), obj(p, MAP + "a b c.png"))[1],
        both(ORANGE),
    ),
    Case(
        "OBJ: a quoted name", lambda p: (picture(p / "a b.png"), obj(p, MAP + '"a b.png"'))[1], both(ORANGE)
    ),
    Case(
        "OBJ: options",
        lambda p: (picture(p / "a b.png"), obj(p, MAP + "-s 1 1 1 -o 0.0 0 -mm 0 1 -clamp on -bm 1 a b.png"))[
            1
        ],
        both(ORANGE),
    ),
    Case(
        "OBJ: path of another system",
        lambda p: (picture(p / "t.png"), obj(p, MAP + r"C:\Users\me\My Models\T.PNG"))[1],
        both(ORANGE),
    ),
    Case(
        "OBJ: folder of another system",
        lambda p: ((p / "maps").mkdir(), picture(p / "maps" / "t.png"), obj(p, MAP + r"maps\t.png"))[2],
        both(ORANGE),
    ),
    Case(
        "OBJ: texture one folder up",
        lambda p: ((p / "m").mkdir(), picture(p / "t.png"), obj(p / "m", MAP + "../t.png"))[2],
        both(ORANGE),
    ),
    Case("OBJ: two materials", lambda p: obj(p, "newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\n"), (RED, BLUE)),
    Case(
        "OBJ: texture and a plain material that share coordinates",
        lambda p: (picture(p / "t.png", GREEN), obj(p, MAP + "t.png\nnewmtl b\nKd 0 0 1\n"))[1],
        (GREEN, BLUE),
    ),
    Case(
        "OBJ: a material without colour",
        lambda p: obj(p, "newmtl a\nKd 1 0 0\nnewmtl b\nNs 3\n"),
        (RED, GREY),
    ),
    Case(
        "OBJ: mtllib is missing",
        lambda p: obj(p, None),
        both(GREY),
        "material file was not found: there is no a.mtl",
    ),
    Case("OBJ: quoted mtllib", lambda p: obj(p, "newmtl a\nKd 1 0 0\n", 'mtllib "a.mtl"'), both(RED)),
    Case(
        "OBJ: texture is missing", lambda p: obj(p, MAP + "t.png"), both(GREY), "texture image was not found"
    ),
    Case(
        "OBJ: texture is no picture",
        lambda p: ((p / "t.png").write_text("?"), obj(p, MAP + "t.png"))[1],
        both(GREY),
        r"texture image cannot be read: .*t\.png",
    ),
    Case(
        "OBJ: palette texture",
        lambda p: (
            Image.new("RGB", (8, 8), (255, 128, 0)).quantize(4).save(p / "t.png"),
            obj(p, MAP + "t.png"),
        )[1],
        both(ORANGE),
    ),
    Case("GLB: nothing", lambda p: glb(p, None), both(GREY)),
    Case(
        "GLB: base colour factor",
        lambda p: glb(p, {"baseColorFactor": [1, 0.2, 0, 1]}),
        both(srgb(1, 0.2, 0)),
    ),
    Case(
        "GLB: colours at vertices",
        lambda p: glb(p, None, np.tile(np.float32([1, 0.2, 0]), (4, 1))),
        both(srgb(1, 0.2, 0)),
    ),
    Case(
        "GLB: colours at vertices in 16 bits",
        lambda p: glb(p, None, np.tile(np.uint16([65535, 13107, 0, 65535]), (4, 1))),
        both(srgb(1, 0.2, 0)),
    ),
    Case(
        "GLB: factor and colours are multiplied",
        lambda p: glb(p, {"baseColorFactor": [0.5, 1, 1, 1]}, np.tile(np.float32([1, 0.2, 0]), (4, 1))),
        both((srgb(0.5)[0], *srgb(0.2, 0))),
    ),
    Case("STL: no colour", lambda p: stl(p, [0, 0]), both(GREY)),
    Case("STL: VisCAM", lambda p: stl(p, [bits(31, 0, 0, 1), bits(0, 0, 31, 1)]), (RED, BLUE)),
    Case("STL: VisCAM, a face without", lambda p: stl(p, [bits(31, 0, 0, 1), 0]), (RED, GREY)),
    Case(
        "STL: Magics",
        lambda p: stl(p, [bits(0, 0, 31, 0), bits(0, 0, 0, 1)], b"COLOR=\x00\x00\xff\xff"),
        (RED, BLUE),
    ),
]


@pytest.mark.parametrize("case", CASES, ids=[case.kind for case in CASES])
def test_colour_that_a_viewer_shows(case: Case, tmp_path: Path) -> None:
    path = case.make(tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = load_mesh(path)
    messages = [str(warning.message) for warning in caught]
    if case.warning is None:
        assert messages == []
    else:
        with pytest.warns(UserWarning, match=case.warning):
            load_mesh(path)
        assert len(messages) == 1
        assert str(path) in messages[0]
    for got, wanted in zip(shown(mesh), case.colors, strict=True):
        assert got == pytest.approx(wanted, abs=0.02)


@pytest.mark.parametrize("orientation", [6, 8])
def test_textures_are_turned_as_pictures_are(tmp_path: Path, orientation: int) -> None:
    upright = np.zeros((8, 8, 3), np.uint8)
    upright[:, :4] = (255, 0, 0)  # left red, right black
    lying = np.rot90(upright, 1 if orientation == 6 else -1)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(lying)).save(tmp_path / "t.png", exif=exif)
    mesh = load_mesh(obj(tmp_path, MAP + "t.png"))
    assert torch.equal(mesh.texture[0], torch.from_numpy(upright[..., 0] / 255.0).float())


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda p: stl(p, [0, 0]), both(BLUE)),
        (lambda p: stl(p, [bits(31, 0, 0, 1), 0]), (RED, BLUE)),
        (lambda p: obj(p, "newmtl a\nKd 1 0 0\nnewmtl b\nNs 3\n"), (RED, BLUE)),
        (lambda p: (picture(p / "t.png", GREEN), obj(p, MAP + "t.png\nnewmtl b\nNs 3\n"))[1], (GREEN, BLUE)),
        (lambda p: ply(p / "a.ply", UCHAR), both(ORANGE)),
    ],
)
def test_a_given_colour_is_for_what_has_none(tmp_path: Path, make, wanted) -> None:
    path = make(tmp_path)
    mesh = load_mesh(path, color=[0.0, 0.0, 1.0])
    for got, color in zip(shown(mesh), wanted, strict=True):
        assert got == pytest.approx(color, abs=0.02)
    if wanted != both(ORANGE):
        assert mesh.checksum != load_mesh(path).checksum


@pytest.mark.parametrize("color", [[1.0, 0.5], [255, 128, 0], [0.1, 0.2, 0.3, 1.0], [-0.1, 0.0, 0.0]])
def test_a_colour_that_is_none_is_refused(tmp_path: Path, color: list[float]) -> None:
    with pytest.raises(ValueError, match=r"color must be \[red,green,blue\] in \[0, 1\], got"):
        load_mesh(stl(tmp_path, [0, 0]), color)


@pytest.mark.parametrize(
    ("kind", "content", "message"),
    [
        ("a.ply", b"", "cannot be read as a mesh"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "cannot be read as a mesh|contains no triangles"),
        ("a.stl", b"solid nothing\nendsolid nothing\n", "contains no triangles|cannot be read"),
        ("a.glb", b"glTF", "cannot be read as a mesh"),
        ("a.gltf", b"{}", "contains no triangles|cannot be read"),
    ],
)
def test_files_that_hold_no_mesh(tmp_path: Path, kind: str, content: bytes, message: str) -> None:
    (tmp_path / kind).write_bytes(content)
    with pytest.raises(MeshError, match=message) as error:
        load_mesh(tmp_path / kind)
    assert kind in str(error.value)


def test_a_mesh_far_from_its_origin(tmp_path: Path) -> None:
    box = trimesh.creation.box((10.0, 20.0, 30.0))
    near = Mesh(torch.tensor(box.vertices), torch.tensor(box.faces))
    # Within the limit, what is rendered is the same to a hundred thousandth of the size.
    shift = np.array([2000.0, -1500.0, 500.0])
    box.apply_translation(shift)
    box.export(tmp_path / "far.ply")
    far = load_mesh(tmp_path / "far.ply")
    assert far.diameter == pytest.approx(near.diameter, rel=1e-5)
    T = torch.eye(4, dtype=torch.float64)[None]
    T[:, 2, 3] = 150.0
    T_far = T.clone()
    T_far[:, :3, 3] -= torch.from_numpy(shift)
    a, b = (RaycastRenderer(1)(m, pose, K, (64, 64)) for m, pose in ((near, T), (far, T_far)))
    assert torch.equal(a.mask, b.mask)
    assert (a.depth - b.depth).abs().max() < 1e-5 * near.diameter
    box.apply_translation([1e6, 0.0, 0.0])
    box.export(tmp_path / "very_far.ply", encoding="ascii")
    message = (
        r"very_far\.ply: .* from its origin, .* times its size of 37\.4.*subtract its centre \[1002000\.0"
    )
    with pytest.raises(MeshError, match=message):
        load_mesh(tmp_path / "very_far.ply")


def test_a_datasets_colour_is_part_of_what_its_representations_are_named_after(tmp_path: Path) -> None:
    path = stl(tmp_path, [0, 0])
    dataset = SimpleNamespace(
        name="plain",
        models=tmp_path,
        mesh_path=lambda _: path,
        diameter=lambda _: np.sqrt(8.0),
        object_name=lambda _: "1",
    )
    store = SimpleNamespace(folder=tmp_path.parent / "store", path_of=lambda checksum, _: checksum)
    for color in (None, [1.0, 0.0, 0.0], None):
        objects = DatasetObjects(dataset, store, color=color)
        assert objects.path(1) == load_mesh(path, color).checksum
        objects.onboard([])  # remembers the checksum for the next

"""Estimated poses as a 3D scene that any viewer of GLB files opens: camera, picture and objects."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from foundpose.geometry import unproject_pixels
from foundpose.rendering import Mesh
from foundpose.utils.files import write_atomically
from foundpose.visualization.overlay import to_pil

# glTF's y is up and its cameras look along −z.
GLTF_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
_BEHIND = 1.2  # the picture's distance, of the farthest object's
_FRUSTUM = (70, 110, 220, 255)


def pose_scene(image: Tensor, K: Tensor, objects: Sequence[tuple[Mesh, Tensor]]) -> trimesh.Scene:
    """The camera's frustum, the picture behind the objects, and the objects, in glTF's axes (y up).

    Seen from the camera's place (the origin, along −z), objects cover their images in the picture.

    Args:
        image: (3, H, W) in [0, 1], without distortion.
        K: (3, 3) its intrinsics.
        objects: meshes and their ``T_camera_from_model`` (4, 4), all in one unit.

    Returns:
        A scene with the geometries ``picture``, ``camera`` and ``object_0``, ….

    Raises:
        ValueError: an object behind the camera.
    """
    scene = trimesh.Scene()
    farthest = 0.0
    for number, (mesh, T) in enumerate(objects):
        placed = T.detach().cpu().double().numpy()
        distance = placed[2, 3] + 0.5 * mesh.diameter
        if distance <= 0:
            raise ValueError(f"object {number} lies behind the camera: its translation is {placed[:3, 3]}")
        farthest = max(farthest, distance)
        name = f"object_{number}"
        scene.add_geometry(_to_trimesh(mesh), name, name, transform=GLTF_FROM_CAMERA @ placed)
    _add_camera(scene, image, K, _BEHIND * (farthest or 1.0))
    return scene


def write_scene(path: str | Path, image: Tensor, K: Tensor, objects: Sequence[tuple[Mesh, Tensor]]) -> None:
    """Write :func:`pose_scene` as a GLB file, whole or not at all."""
    scene = pose_scene(image, K, objects)
    write_atomically(Path(path), lambda temporary: scene.export(temporary, file_type="glb"))


def _add_camera(scene: trimesh.Scene, image: Tensor, K: Tensor, depth: float) -> None:
    """The picture at a depth, and lines from the camera's centre to its corners."""
    height, width = image.shape[1:]
    right, bottom = width - 0.5, height - 0.5  # pixel edges
    pixels = torch.tensor([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]], dtype=torch.float64)
    corners = unproject_pixels(pixels, torch.full((4,), depth).double(), K.detach().cpu().double()).numpy()
    material = PBRMaterial(
        baseColorTexture=to_pil(image), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    plane = trimesh.Trimesh(
        corners, [[0, 2, 1], [0, 3, 2]], visual=TextureVisuals(uv=uv, material=material), process=False
    )
    scene.add_geometry(plane, "picture", "picture", transform=GLTF_FROM_CAMERA)
    segments = [(np.zeros(3), corner) for corner in corners]
    frustum = trimesh.load_path(np.array(segments))
    frustum.colors = np.array([_FRUSTUM] * len(frustum.entities), dtype=np.uint8)
    scene.add_geometry(frustum, "camera", "camera", transform=GLTF_FROM_CAMERA)


def _to_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    """A mesh with its colours or texture."""
    visual: TextureVisuals | None = None
    colors: NDArray[np.uint8] | None = None
    if mesh.texture is not None and mesh.uv is not None:
        material = PBRMaterial(baseColorTexture=to_pil(mesh.texture), metallicFactor=0.0, roughnessFactor=1.0)
        visual = TextureVisuals(uv=mesh.uv.numpy(), material=material)
    elif mesh.vertex_colors is not None:
        colors = (mesh.vertex_colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return trimesh.Trimesh(
        mesh.vertices.numpy(),
        mesh.faces.numpy(),
        vertex_normals=mesh.vertex_normals.numpy(),
        vertex_colors=colors,
        visual=visual,
        process=False,
    )

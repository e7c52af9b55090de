"""Rasterisation with OpenGL through pyrender and EGL."""

import os
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from foundpose.rendering.base import Renderer, Trace, View
from foundpose.rendering.mesh import Mesh
from foundpose.rendering.shading import AMBIENT, Hits, Surface, surface_of

_SHADERS = Path(__file__).parent / "shaders"
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_HELP = (
    "PyrenderRenderer needs pyrender (pip install 'foundpose[opengl]') and a working EGL (on Debian and Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri). RaycastRenderer gives the same pictures and needs neither"
)


class RendererNotAvailableError(RuntimeError):
    """This machine lacks what a renderer needs."""


class FaceRasterizer:
    """An EGL context that tells which face each pixel sees.

    pyrender's pass without multisampling (segmentation) runs with shaders of our own that write face numbers:
    colours and depths read back from its other passes are averages over a pixel, or those of a sample off its
    centre.

    Args:
        size: (height, width) of the images.

    Raises:
        RendererNotAvailableError: no pyrender or no EGL.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        try:
            import pyrender
            from pyrender.shader_program import ShaderProgramCache

            self.context = pyrender.OffscreenRenderer(viewport_width=size[1], viewport_height=size[0])
        except Exception as error:  # ImportError, or whatever the driver and PyOpenGL raise
            raise RendererNotAvailableError(f"{_HELP} ({type(error).__name__}: {error})") from error
        self.context._renderer._program_cache = ShaderProgramCache(str(_SHADERS))
        self.pyrender = pyrender
        self.scene = pyrender.Scene()
        self.camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0)
        self.scene.add(self.camera)
        self.nodes: WeakKeyDictionary[Mesh, Any] = WeakKeyDictionary()

    def set_mesh(self, mesh: Mesh) -> None:
        """Draw a mesh from now on; meshes stay uploaded as long as they live."""
        for node in self.scene.mesh_nodes - set(self.nodes.values()):
            self.scene.remove_node(node)
        if mesh not in self.nodes:
            self.nodes[mesh] = self._upload(mesh)
        self.node = self.nodes[mesh]

    def _upload(self, mesh: Mesh) -> Any:
        if len(mesh.faces) >= 2**23:
            raise ValueError(
                f"PyrenderRenderer takes meshes of up to {2**23 - 1} faces, got {len(mesh.faces)}"
            )
        faces = mesh.faces.numpy()
        # The pass culls back faces, but both sides are to be seen.
        both = np.concatenate([faces, faces[:, ::-1]])
        primitive = self.pyrender.Primitive(positions=mesh.vertices.numpy(), indices=both)
        return self.scene.add(self.pyrender.Mesh([primitive]))

    def faces_seen(self, view: View, offset: tuple[float, float]) -> NDArray[np.int64]:
        """(H, W) face at each pixel centre moved by ``offset`` (u, v), −1 on the background."""
        K, camera = view.K, self.camera
        if K[0, 1] != 0.0 or K[1, 0] != 0.0:
            raise ValueError("PyrenderRenderer takes intrinsics without skew; RaycastRenderer takes any")
        camera.fx, camera.fy = K[0, 0], K[1, 1]
        # OpenGL counts from the corner of the image, we from the centre of the first pixel.
        camera.cx, camera.cy = K[0, 2] + 0.5 - offset[0], K[1, 2] + 0.5 - offset[1]
        margin = 1e-3 * (view.far - view.near) + 1e-6 * view.far
        camera.znear, camera.zfar = max(view.near - margin, 1e-4 * view.far), view.far + margin
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = view.linear, view.translation
        self.scene.set_pose(self.node, _GL_FROM_CV @ pose)
        self.context.viewport_height, self.context.viewport_width = view.size
        flags = self.pyrender.RenderFlags.SEG
        colors, _ = self.context.render(self.scene, flags, {self.node: (255, 255, 255)})
        number = colors.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
        count = len(self.node.mesh.primitives[0].indices) // 2
        return np.where(number > 0, (number - 1) % count, -1)

    def trace(self, surface: Surface, view: View, offset: tuple[float, float]) -> Hits:
        """First hits of the window's pixels moved by ``offset``."""
        left, top, right, bottom = view.window
        seen = self.faces_seen(view, offset)[top:bottom, left:right].reshape(-1)
        pixel = np.flatnonzero(seen >= 0)
        columns, rows, middle = view.pixel_rays(offset)
        row, column = np.divmod(pixel, right - left)
        rays = columns[column] + rows[row] + middle
        return Hits(pixel, seen[pixel], barycentric(surface, view, seen[pixel], rays))


class PyrenderRenderer(Renderer):
    """Rasterises with OpenGL (pyrender over EGL), on a GPU where the driver offers one.

    OpenGL decides what is visible; light, textures, depth and normals are computed as in
    :class:`RaycastRenderer`, so both give the same pictures.

    Args:
        supersampling: n; colours are the mean of n × n regular samples per pixel.
        ambient: share of ambient light in [0, 1]; the rest shines along the camera's axis.

    Raises:
        RendererNotAvailableError: (on the first call) pyrender or EGL is missing.
        ValueError: (on a call) intrinsics with skew, which OpenGL's camera does not have here.
    """

    def __init__(self, supersampling: int = 2, ambient: float = AMBIENT) -> None:
        super().__init__(supersampling, ambient)
        self._rasterizer: FaceRasterizer | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A GL context belongs to its process and cannot be copied.
        return {**self.__dict__, "_rasterizer": None}

    def _tracer(self, mesh: Mesh, size: tuple[int, int]) -> Trace:
        if self._rasterizer is None:
            self._rasterizer = FaceRasterizer(size)
        self._rasterizer.set_mesh(mesh)
        return partial(self._rasterizer.trace, surface_of(mesh))


def barycentric(
    surface: Surface, view: View, face: NDArray[np.int64], rays: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Where rays from the camera meet given faces.

    Args:
        surface: the mesh's surface.
        view: the camera.
        face: (M,) faces.
        rays: (M, 3) camera frame, any length.

    Returns:
        (M, 3) barycentric coordinates. A ray that misses its face, as rasterisation rounds vertices to a
        fraction of a pixel, gets a point on the face's edge.
    """
    a, b, c = np.moveaxis(surface.vertices[surface.faces[face]] @ view.linear.T + view.translation, 1, 0)
    # Signed volumes of the ray with two corners each: Cramer's rule for ray = wa a + wb b + wc c.
    weights = np.stack(
        [np.einsum("mi,mi->m", rays, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], axis=1
    )
    total = weights.sum(1, keepdims=True)
    weights = np.divide(weights, total, out=np.full_like(weights, 1.0 / 3.0), where=total != 0.0).clip(0.0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)

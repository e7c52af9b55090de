"""Ray casting on the CPU with Embree: needs no OpenGL."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from foundpose.rendering.base import Renderer, Trace, View
from foundpose.rendering.mesh import Mesh, once_per_mesh
from foundpose.rendering.shading import Hits


class RayScene:
    """A mesh in Embree's acceleration structure.

    Embree computes in float32, so the mesh is traced in a box of unit size around the origin, and rays start
    where the mesh begins instead of at the camera: accuracy depends neither on the unit of length nor on the
    camera's distance.

    Args:
        mesh: the mesh.
    """

    def __init__(self, mesh: Mesh) -> None:
        bounds = mesh.bounds.numpy().astype(np.float64)
        self.centre = bounds.mean(0)
        self.scale = 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
        vertices = (mesh.vertices.numpy() - self.centre) / self.scale
        self.scene = EmbreeScene(robust=True)
        self.geometry = TriangleMesh(
            self.scene, vertices.astype(np.float32), mesh.faces.numpy().astype(np.int32)
        )
        # The first query builds the hierarchy, which must not happen on several threads.
        self.scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def trace(self, view: View, offset: tuple[float, float]) -> Hits:
        """First hits of the rays through the window's pixels, moved by ``offset`` (u, v) pixels."""
        to_model = np.linalg.inv(view.linear)
        columns, rows, middle = (part @ to_model.T for part in view.pixel_rays(offset))
        start = max(view.near - 1e-3 * self.scale, 0.0)
        eye = -(to_model @ view.translation)
        origin = (eye + start * middle - self.centre) / self.scale
        directions = _outer_sum(columns, rows + middle)
        origins = _outer_sum(columns * (start / self.scale), rows * (start / self.scale) + origin)
        found = self.scene.run(origins, directions, output=1)
        pixel = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][pixel], found["v"][pixel]
        return Hits(pixel, found["primID"][pixel], np.stack([1.0 - u - v, u, v], axis=1))


ray_scene_of = once_per_mesh(RayScene)
"""A mesh's :class:`RayScene`."""


class RaycastRenderer(Renderer):
    """Casts rays with Embree on the CPU's cores (as many threads as ``torch.get_num_threads()``).

    Args:
        supersampling: n; colours are the mean of n × n regular samples per pixel.
        ambient: share of ambient light in [0, 1]; the rest shines along the camera's axis.
    """

    in_threads = True

    def _tracer(self, mesh: Mesh, size: tuple[int, int]) -> Trace:
        return ray_scene_of(mesh).trace


def _outer_sum(columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """(w, 3) and (h, 3) → (h * w, 3), row after row."""
    return (rows.astype(np.float32)[:, None] + columns.astype(np.float32)[None]).reshape(-1, 3)

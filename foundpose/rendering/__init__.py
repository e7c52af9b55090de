"""Mesh loading and renderers behind one interface."""

from foundpose.rendering.base import Renderer, RenderOutput
from foundpose.rendering.coordinates import CoordinateRenderer, render_coordinate_image
from foundpose.rendering.gl import PyrenderRenderer, RendererNotAvailableError
from foundpose.rendering.mesh import Mesh, MeshError
from foundpose.rendering.mesh_files import load_mesh
from foundpose.rendering.raycast import RaycastRenderer

__all__ = [
    "CoordinateRenderer",
    "Mesh",
    "MeshError",
    "PyrenderRenderer",
    "RaycastRenderer",
    "RenderOutput",
    "Renderer",
    "RendererNotAvailableError",
    "load_mesh",
    "render_coordinate_image",
]

"""Mesh loading and renderers behind one interface."""

from foundpose.rendering.base import Renderer, RenderOutput
from foundpose.rendering.coordinates import CoordinateRenderer, render_coordinate_image
from foundpose.rendering.gl import PyrenderRenderer, RendererNotAvailableError
from foundpose.rendering.mesh import Mesh, MeshError, load_mesh, warn_if_scale_implausible
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
    "warn_if_scale_implausible",
]

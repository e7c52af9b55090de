import pytest

from foundpose.rendering import RaycastRenderer, Renderer
from tests.rendering.scenes import gl_renderer_or_skip


@pytest.fixture(params=["raycast", "gl"])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    """Each renderer in turn."""
    return RaycastRenderer() if request.param == "raycast" else gl_renderer_or_skip()

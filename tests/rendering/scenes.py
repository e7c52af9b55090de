"""Cameras, meshes and renderers for the rendering tests."""

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from foundpose.geometry.cameras import intrinsics_matrix
from foundpose.rendering import Mesh, PyrenderRenderer


def gl_renderer_or_skip(**settings: float) -> PyrenderRenderer:
    """A working OpenGL renderer; the test is skipped, with the reason, where there is no EGL."""
    renderer = PyrenderRenderer(**settings)
    try:
        renderer(square(), look_at(10.0), intrinsics_matrix(10.0, 10.0, 3.5, 3.5)[None], (8, 8))
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    return renderer


def square(side: float = 2.0, colors: Tensor | None = None, textured: Tensor | None = None) -> Mesh:
    """A square in the plane z = 0 of the model frame, centred, x right and y down as seen from z < 0."""
    corners = torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    uv = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])  # v up: the top row is v = 1
    return Mesh(
        vertices=corners * side / 2,
        faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
        vertex_colors=colors,
        uv=None if textured is None else uv,
        texture=textured,
    )


def look_at(distance: float, dtype: torch.dtype = torch.float32) -> Tensor:
    """(1, 4, 4) pose of a model straight ahead."""
    T = torch.eye(4, dtype=dtype)[None]
    T[:, 2, 3] = distance
    return T


def random_poses(count: int, distance: float, seed: int = 0, centre: Tensor | None = None) -> Tensor:
    """(B, 4, 4) random orientations about ``centre``, straight ahead."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    R = torch.from_numpy(q * np.linalg.det(q)[:, None, None])
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, :3] = R
    if centre is not None:
        T[:, :3, 3] = -(R @ centre.double())
    T[:, 2, 3] += distance
    return T


def camera_filling(mesh: Mesh, distance: float, size: int, fill: float = 0.6) -> Tensor:
    """(1, 3, 3) intrinsics under which a sphere of the mesh's diameter takes about ``fill`` of the image."""
    f = fill * size * distance / mesh.diameter
    return intrinsics_matrix(f, f, (size - 1) / 2, (size - 1) / 2)[None]


def icosphere(subdivisions: int = 5, radius: float = 1.0) -> Mesh:
    """A finely faceted sphere."""
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(torch.tensor(sphere.vertices), torch.tensor(sphere.faces))


def textured_torus() -> Mesh:
    """A closed, non-convex mesh with a detailed texture that repeats."""
    n, m = 60, 40
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, n + 1), np.linspace(0, 2 * np.pi, m + 1), indexing="ij")
    ring = 2.0 + 0.8 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), 0.8 * np.sin(b)], -1).reshape(-1, 3)
    uv = np.stack([3 * a / (2 * np.pi), b / (2 * np.pi)], -1).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    p, q = (i * (m + 1) + j).ravel(), ((i + 1) * (m + 1) + j).ravel()
    faces = np.concatenate([np.stack([p, q, q + 1], 1), np.stack([p, q + 1, p + 1], 1)])
    texture = torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(0))
    return Mesh(torch.tensor(vertices), torch.tensor(faces), uv=torch.tensor(uv), texture=texture)

"""The renderer interface, and what every renderer does the same way."""

from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from foundpose.rendering.mesh import Mesh
from foundpose.rendering.shading import AMBIENT, Array64, Hits, Surface, interpolate, light, surface_of
from foundpose.utils.settings import Configured, Setting


class RenderOutput(NamedTuple):
    """Pictures of one mesh from B cameras.

    Attributes:
        rgb: (B, 3, H, W) in [0, 1], anti-aliased, black background.
        depth: (B, H, W) z in the camera frame at the pixel centres (integer coordinates), mesh units; 0 on the
            background. Not averaged.
        mask: (B, H, W) bool, the surface is seen at the pixel centre.
        normals: (B, 3, H, W) unit length, camera frame, facing the camera; 0 on the background. Not averaged.
    """

    rgb: Tensor
    depth: Tensor
    mask: Tensor
    normals: Tensor


class View(NamedTuple):
    """One camera, float64, with the part of its image that the mesh can cover.

    Attributes:
        linear, translation: (3, 3) and (3,): model frame to camera frame.
        K: (3, 3) intrinsics.
        size: image (height, width).
        window: (left, top, right, bottom) in pixels, right and bottom exclusive; empty when nothing is in view.
        near, far: depth range of the mesh, near ≥ 0.
    """

    linear: Array64
    translation: Array64
    K: Array64
    size: tuple[int, int]
    window: tuple[int, int, int, int]
    near: float
    far: float

    def pixel_rays(self, offset: tuple[float, float]) -> tuple[Array64, Array64, Array64]:
        """Rays with z = 1 through the window's pixels, moved by ``offset``, as column + row + centre parts.

        Returns:
            (w, 3), (h, 3) and (3,) in the camera frame: pixel (row, column)'s ray is the sum of the three. The
            parts stay small beside the centre, so adding them in float32 costs no accuracy.
        """
        left, top, right, bottom = self.window
        K_inv = np.linalg.inv(self.K)
        middle_u, middle_v = (left + right - 1) / 2, (top + bottom - 1) / 2
        columns = (np.arange(left, right) - middle_u)[:, None] * K_inv[:, 0]
        rows = (np.arange(top, bottom) - middle_v)[:, None] * K_inv[:, 1]
        return columns, rows, K_inv @ np.array([middle_u + offset[0], middle_v + offset[1], 1.0])


Trace = Callable[[View, tuple[float, float]], Hits]
"""Finds what the pixels of a view's window, moved by an offset (u, v) in pixels, see first."""


class Renderer(Configured):
    """Renders a mesh from a batch of cameras; subclasses decide which face each sample sees.

    The light is fixed to the camera: ``ambient`` from everywhere, the rest along the optical axis, on both
    sides of a face alike. Background is black. A subclass with settings of its own adds them to :meth:`settings`.

    Args:
        supersampling: n; colours are the mean of n × n regular samples per pixel. Depth, mask and normals are
            those of the pixel centre.
        ambient: share of ambient light in [0, 1].

    Attributes:
        bits: 8 or 16, to which onboarding rounds the colours of templates. A camera has 8.
        in_threads: whether views may be traced on several threads.

    Raises:
        ValueError: an argument out of range.
    """

    bits: int = 8
    in_threads: bool = False

    def __init__(self, supersampling: int = 2, ambient: float = AMBIENT) -> None:
        super().__init__()
        if supersampling < 1 or int(supersampling) != supersampling:
            raise ValueError(f"supersampling must be a whole number of at least 1, got {supersampling}")
        if not 0.0 <= ambient <= 1.0:
            raise ValueError(f"ambient must lie in [0, 1], got {ambient}")
        self.supersampling = int(supersampling)
        self.ambient = float(ambient)

    def forward(
        self, mesh: Mesh, T_camera_from_model: Tensor, K: Tensor, size: tuple[int, int]
    ) -> RenderOutput:
        """Render.

        Args:
            mesh: the mesh.
            T_camera_from_model: (B, 4, 4), float32 or float64, translations in mesh units. The 3 × 3 part may
                deviate from a rotation (BOP's annotations do, by up to half a percent).
            K: (B, 3, 3) or (1, 3, 3) intrinsics in pixels, last row (0, 0, 1).
            size: (height, width) of the images.

        Returns:
            Images on the device and in the dtype of ``T_camera_from_model``: 29 bytes per pixel in float32,
            so render large sets in chunks. A view that shows nothing of the mesh, or whose pose or intrinsics
            are not finite or not invertible, is empty (``mask`` all False).

        Raises:
            ValueError: wrong shapes or dtypes.

        Differentiable w.r.t. nothing: the images are constants.
        """
        _check_inputs(T_camera_from_model, K, size)
        T = T_camera_from_model.detach()
        surface = surface_of(mesh)
        T_array = T.to("cpu", torch.float64).numpy()
        K_array = K.detach().to("cpu", torch.float64).expand(len(T), 3, 3).numpy()
        views = [make_view(surface, *camera, size) for camera in zip(T_array, K_array, strict=True)]
        # Filled as CPU arrays and moved once.
        output = RenderOutput(
            rgb=torch.zeros(len(T), 3, *size, dtype=T.dtype),
            depth=torch.zeros(len(T), *size, dtype=T.dtype),
            mask=torch.zeros(len(T), *size, dtype=torch.bool),
            normals=torch.zeros(len(T), 3, *size, dtype=T.dtype),
        )
        arrays = [tensor.numpy() for tensor in output]
        jobs = [(view, [a[i] for a in arrays]) for i, view in enumerate(views) if not is_empty(view)]
        if jobs:
            trace = self._tracer(mesh, size)
            # NumPy releases the interpreter lock, so threads share the views without copies.
            count = min(torch.get_num_threads(), len(jobs)) if self.in_threads else 1
            if count > 1:
                with ThreadPoolExecutor(count) as pool:
                    list(pool.map(lambda job: self._render_view(surface, trace, *job), jobs))
            else:
                for job in jobs:
                    self._render_view(surface, trace, *job)
        return RenderOutput(*(tensor.to(T.device) for tensor in output))

    def settings(self) -> dict[str, Setting]:
        """All that changes the pictures; what is kept of them on disk is named after it."""
        return {"supersampling": self.supersampling, "ambient": self.ambient}

    @abstractmethod
    def _tracer(self, mesh: Mesh, size: tuple[int, int]) -> Trace:
        """What finds the surface that a view's pixels see, for images (height, width)."""

    def _render_view(self, surface: Surface, trace: Trace, view: View, images: list[NDArray[Any]]) -> None:
        """Fill images of zeros (3, H, W), (H, W), (H, W), (3, H, W) with one view."""
        left, top, right, bottom = view.window
        rgb, depth, mask, normals = (image[..., top:bottom, left:right] for image in images)
        n = self.supersampling
        steps = [(i + 0.5) / n - 0.5 for i in range(n)]
        # Normals transform with the inverse transpose; row 2 gives their z in the camera frame.
        to_camera = np.linalg.inv(view.linear).T
        camera_axis = to_camera[2] / np.linalg.norm(to_camera[2])
        spacing = 0.5 * (view.near + view.far) / (view.K[0, 0] * n)
        total = np.zeros((mask.size, 3), np.float32)
        centre = None
        for offset in [(du, dv) for dv in steps for du in steps]:
            hits = trace(view, offset)
            model_normals, albedo = surface.normals_and_albedo(hits, spacing)
            total[hits.pixel] += light(albedo, model_normals, camera_axis, self.ambient)
            if offset == (0.0, 0.0):
                centre = hits
        rgb[...] = (total / n**2).clip(0.0, 1.0).T.reshape(rgb.shape)
        centre = centre if centre is not None else trace(view, (0.0, 0.0))
        at, column = np.divmod(centre.pixel, mask.shape[1])
        depth[at, column] = surface_depth(surface, view, centre)
        mask[at, column] = True
        normal = interpolate(surface.corners, centre)[:, :3].astype(np.float64) @ np.linalg.inv(view.linear)
        columns, rows, middle = view.pixel_rays((0.0, 0.0))
        away = np.einsum("mi,mi->m", normal, columns[column] + rows[at] + middle) > 0.0
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        normal *= np.where(away, -1.0, 1.0)[:, None]
        normals[:, at, column] = normal.T


def surface_depth(surface: Surface, view: View, hits: Hits) -> Array64:
    """z (M,) in the camera frame where samples meet the surface."""
    z = (surface.vertices @ view.linear[2] + view.translation[2])[surface.faces[hits.face]]
    # Differences, as float32 weights add up to 1 only within 1e-7 of what may be a large distance.
    w = hits.weights.astype(np.float64)
    depth: Array64 = z[:, 0] + w[:, 1] * (z[:, 1] - z[:, 0]) + w[:, 2] * (z[:, 2] - z[:, 0])
    return depth


def make_view(surface: Surface, T: Array64, K: Array64, size: tuple[int, int]) -> View:
    """Find what part of the image a mesh can cover.

    Args:
        surface: the mesh's surface.
        T: (4, 4) ``T_camera_from_model``.
        K: (3, 3) intrinsics.
        size: (height, width).
    """
    height, width = size
    linear, translation = T[:3, :3], T[:3, 3]
    nothing = View(linear, translation, K, size, (0, 0, 0, 0), 0.0, 0.0)
    if not (np.isfinite(T).all() and np.isfinite(K).all()):
        return nothing
    if min(abs(np.linalg.det(linear)), abs(np.linalg.det(K))) < 1e-12:
        return nothing
    points = surface.hull @ linear.T + translation
    near, far = float(points[:, 2].min()), float(points[:, 2].max())
    if far <= 0.0:
        return nothing
    window = (0, 0, width, height)
    if near > 1e-6 * far:
        # The projection of a body in front of the camera lies in the hull of its projected vertices. A pixel
        # sees [u - 0.5, u + 0.5]; rounding outwards covers that.
        pixels = (points / points[:, 2:]) @ K.T[:, :2]
        low, high = np.floor(pixels.min(0)), np.ceil(pixels.max(0)) + 1
        low, high = np.clip(low, 0, (width, height)), np.clip(high, 0, (width, height))
        window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return View(linear, translation, K, size, window, max(near, 0.0), far)


def is_empty(view: View) -> bool:
    """Whether nothing of the mesh can be seen."""
    left, top, right, bottom = view.window
    return right <= left or bottom <= top


def _check_inputs(T: Tensor, K: Tensor, size: tuple[int, int]) -> None:
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise ValueError(f"T_camera_from_model must have shape (B, 4, 4), got {tuple(T.shape)}")
    if K.ndim != 3 or K.shape[1:] != (3, 3) or K.shape[0] not in (1, T.shape[0]):
        raise ValueError(
            f"K must have shape (B, 3, 3) or (1, 3, 3) with B = {T.shape[0]}, got {tuple(K.shape)}"
        )
    if T.dtype not in (torch.float32, torch.float64) or not K.is_floating_point():
        raise ValueError(f"poses must be float32 or float64 and K floating, got {T.dtype} and {K.dtype}")
    if len(size) != 2 or any(int(side) != side or side < 1 for side in size):
        raise ValueError(f"size must be (height, width), whole numbers of at least 1, got {tuple(size)}")

"""VSD of pairs of poses in one depth image: rendering and comparing in the windows that hold both objects."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from foundpose.bop.vsd import BOP_DELTA, vsd
from foundpose.rendering import Mesh
from foundpose.rendering.base import View, make_view, surface_depth
from foundpose.rendering.raycast import RayScene
from foundpose.rendering.shading import Surface

_PIXELS_PER_CHUNK = 2**20
"""Bounds the memory of a comparison to about 100 MB."""


class DepthObject:
    """An object whose depth is rendered as by BOP's toolkit: in the intrinsics' plane at (u + 0.5, v + 0.5).

    Args:
        vertices: (V, 3) in the model frame, mesh units.
        faces: (F, 3) vertex indices.
        diameter: as published, mesh units.

    Raises:
        MeshError: not a usable mesh.
    """

    def __init__(self, vertices: Tensor, faces: Tensor, diameter: float) -> None:
        mesh = Mesh(vertices, faces)
        self.diameter = float(diameter)
        self._surface = Surface(mesh)
        self._scene = RayScene(mesh)

    def view(self, T_camera_from_model: Tensor, K: Tensor, size: tuple[int, int]) -> View:
        """What a camera can see of the object; an empty window for a pose that is not finite.

        Args:
            T_camera_from_model: (4, 4); the rotation may be scaled, as BOP's annotations are.
            K: (3, 3) intrinsics, pixels.
            size: (height, width).
        """
        shift = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        T, intrinsics = (value.detach().cpu().double().numpy() for value in (T_camera_from_model, K))
        return make_view(self._surface, T, intrinsics - shift, size)

    def render(self, view: View) -> NDArray[np.float32]:
        """Depth (h, w) in the view's window, 0 off the object."""
        left, top, right, bottom = view.window
        depth = np.zeros(max(bottom - top, 0) * max(right - left, 0), np.float32)
        if depth.size:
            hits = self._scene.trace(view, (0.0, 0.0))
            depth[hits.pixel] = surface_depth(self._surface, view, hits)
        return depth.reshape(max(bottom - top, 0), max(right - left, 0))


class PosedObject(NamedTuple):
    """An object at a pose (4, 4) in the camera's frame."""

    object: DepthObject
    T_camera_from_model: Tensor


class DepthImage(NamedTuple):
    """What a depth camera measured.

    Attributes:
        depth: (H, W) z of the surface in mesh units, 0 without measurement.
        K: (3, 3) intrinsics, pixels.
    """

    depth: Tensor
    K: Tensor


def vsd_of_pairs(
    estimates: Sequence[PosedObject],
    truths: Sequence[PosedObject],
    pairs: Tensor,
    image: DepthImage,
    taus: Sequence[float],
    delta: float = BOP_DELTA,
    device: torch.device | str = "cpu",
) -> Tensor:
    """VSD of pairs of poses in one image. Every pose is rendered once, and only if one of its pairs needs it.

    Args:
        estimates: E objects at estimated poses.
        truths: A objects at true poses.
        pairs: (P, 2) integers: which estimate against which truth, both of the same object.
        image: what was measured.
        taus: misalignment tolerances, shares of the diameter.
        delta: visibility tolerance, mesh units.
        device: where the images are compared; rays are cast on the CPU's cores.

    Returns:
        (P, len(taus)) float64 on the CPU.

    Differentiable w.r.t. nothing.
    """
    depth, K = image
    size = (int(depth.shape[0]), int(depth.shape[1]))
    views = [
        [item.object.view(item.T_camera_from_model, K, size) for item in side] for side in (estimates, truths)
    ]
    windows = [np.array([view.window for view in side]).reshape(-1, 4) for side in views]
    index = pairs.cpu().numpy().reshape(-1, 2)
    est, true = windows[0][index[:, 0]], windows[1][index[:, 1]]
    # Silhouettes in windows that do not meet have no pixel in common, for which VSD is 1.
    meet = (np.maximum(est, true)[:, :2] < np.minimum(est, true)[:, 2:]).all(1)
    result = torch.ones(len(index), len(taus), dtype=torch.float64)
    union = np.concatenate([np.minimum(est, true)[:, :2], np.maximum(est, true)[:, 2:]], axis=1)
    patches = [
        _render_needed(items, side, index[meet, k])
        for k, (items, side) in enumerate(zip((estimates, truths), views, strict=True))
    ]
    measured = depth.detach().cpu().numpy()
    for chunk in _chunks(union, np.flatnonzero(meet)):
        sides = union[chunk, 2:] - union[chunk, :2]
        images = np.zeros((3, len(chunk), int(sides[:, 1].max()), int(sides[:, 0].max())), np.float32)
        for place, pair in enumerate(chunk):
            left, top, right, bottom = union[pair]
            images[2, place, : bottom - top, : right - left] = measured[top:bottom, left:right]
            for k in (0, 1):
                first, patch = windows[k][index[pair, k]], patches[k][int(index[pair, k])]
                row, column = first[1] - top, first[0] - left
                images[k, place, row : row + patch.shape[0], column : column + patch.shape[1]] = patch
        # Distances in float64, as the toolkit's; the depth images are float32 in both.
        depth_est, depth_true, depth_test = torch.from_numpy(images).to(device).double()
        K_windows = K.detach().to(device, torch.float64).repeat(len(chunk), 1, 1)
        K_windows[:, :2, 2] -= torch.from_numpy(union[chunk, :2]).to(K_windows)
        diameters = torch.tensor([estimates[i].object.diameter for i in index[chunk, 0]], dtype=torch.float64)
        values = vsd(depth_est, depth_true, depth_test, K_windows, taus, diameters.to(device), delta)
        result[torch.from_numpy(chunk)] = values.cpu()
    return result


def _render_needed(
    items: Sequence[PosedObject], views: Sequence[View], needed: NDArray[np.integer]
) -> dict[int, NDArray[np.float32]]:
    """Depth patches by position. Embree and NumPy release the interpreter lock, so threads share the work."""
    positions = np.unique(needed).tolist()
    with ThreadPoolExecutor(max(1, min(torch.get_num_threads(), len(positions)))) as pool:
        patches = pool.map(lambda i: items[i].object.render(views[i]), positions)
        return dict(zip(positions, patches, strict=True))


def _chunks(windows: NDArray[np.integer], pairs: NDArray[np.integer]) -> Iterator[NDArray[np.integer]]:
    """Pairs of similar window sizes, such that each chunk's padded images stay below the bound."""
    sides = windows[:, 2:] - windows[:, :2]
    pairs = pairs[np.argsort(sides[pairs].prod(1), kind="stable")]
    first = 0
    while first < len(pairs):
        extent = np.maximum.accumulate(sides[pairs[first:]], axis=0).prod(1)
        fits = extent * np.arange(1, len(extent) + 1) <= _PIXELS_PER_CHUNK
        count = max(1, int(fits.argmin()) if not fits.all() else len(fits))
        yield pairs[first : first + count]
        first += count

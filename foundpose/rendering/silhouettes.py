"""Whether a mask can be an object's: its shape against the object's silhouettes from all around."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry import (
    Crops,
    boxes_from_points,
    invert_transform,
    make_transform,
    project_points,
    super_fibonacci_rotations,
    transform_points,
)
from foundpose.rendering.mesh import Mesh
from foundpose.rendering.raycast import RaycastRenderer


class SilhouetteFit(NamedTuple):
    """How an object would fill a mask.

    Attributes:
        overlap: intersection over union of the mask and the silhouette that is most like it.
        T_camera_from_model: (4, 4) float64 a pose with that silhouette: no estimate, as many poses look alike.
        nearest: distance of the object's centre, mesh units, if it shows its smallest side.
        farthest: if it shows its largest side.
        mask: (S, S) bool that silhouette in the crop.
    """

    overlap: float
    T_camera_from_model: Tensor
    nearest: float
    farthest: float
    mask: Tensor


def fit_silhouette(mesh: Mesh, crops: Crops, count: int = 300) -> SilhouetteFit:
    """Compare a mask's shape with the object's silhouettes, each placed so that it has the mask's box.

    Args:
        mesh: the object.
        crops: one crop (B = 1) around the mask.
        count: number of orientations.
    """
    K = crops.K_crop[:1].double()
    inside = crops.masks[0] > 0.5
    rows, columns = torch.nonzero(inside, as_tuple=True)
    target = boxes_from_points(torch.stack([columns, rows], dim=-1).double())
    middle, side = (target[:2] + target[2:]) / 2, (target[2:] - target[:2]).max() + 1
    R = super_fibonacci_rotations(count)
    hull, centre = mesh.hull_vertices.double(), mesh.bounds.double().mean(dim=0)
    position = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * (K[0, 0, 0] * mesh.diameter / side)
    position = position.expand(count, 3)
    for _ in range(4):  # perspective makes size and place depend on each other, a little
        pixels, _ = project_points(transform_points(make_transform(R, position - R @ centre), hull), K)
        box = boxes_from_points(pixels)
        distance = position[:, 2] * (box[:, 2:] - box[:, :2]).amax(dim=1) / side
        off = (middle - (box[:, :2] + box[:, 2:]) / 2) * (distance / K[0, 0, 0])[:, None]
        scaled = position[:, :2] * (distance / position[:, 2])[:, None] + off
        position = torch.cat([scaled, distance[:, None]], dim=1)
    T = make_transform(R, position - R @ centre)
    size = (inside.shape[0], inside.shape[1])
    masks = RaycastRenderer(supersampling=1)(mesh, T, K, size).mask
    union = (masks | inside).sum(dim=(1, 2))
    overlap = (masks & inside).sum(dim=(1, 2)) / union.clamp(min=1)
    best = int(overlap.argmax())
    T_camera = invert_transform(crops.T_crop_from_camera[0].double()) @ T[best]
    far = torch.linalg.vector_norm(position, dim=1)
    return SilhouetteFit(float(overlap[best]), T_camera, float(far.min()), float(far.max()), masks[best])

"""Random Perspective-n-Point problems with known poses."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor


class Scene(NamedTuple):
    points_model: np.ndarray
    points_image: np.ndarray
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    diameter: float


def make_scene(rng: np.random.Generator, count: int, shape: str = "volume", wide: bool = False) -> Scene:
    """Points of an object of 100 to 250 mm in a 420 px crop that it fills to 60 %: from six diameters away
    (focal length 1,512 px), or ``wide``: from 1.2 to 3 diameters."""
    diameter = rng.uniform(100.0, 250.0)
    R = Rotation.random(random_state=rng).as_matrix()
    depth = diameter * (rng.uniform(1.2, 3.0) if wide else 6.0)
    focal = 252.0 * depth / diameter
    K = np.array([[focal, 0.0, 209.5], [0.0, focal, 209.5], [0.0, 0.0, 1.0]])
    t = np.array([*rng.uniform(-0.1, 0.1, 2) * diameter, depth])
    if shape == "ellipsoid":  # the half that the camera sees
        axes = rng.uniform(0.4, 1.0, 3) * diameter / 2
        directions = rng.normal(size=(8 * count + 40, 3))
        points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * axes
        facing = ((points / axes**2) @ R.T * (points @ R.T + t)).sum(1) < 0
        points = points[facing]
    else:
        points = rng.uniform(-0.5, 0.5, (count, 3)) * diameter * rng.uniform(0.3, 1.0, 3)
        if shape == "plane":
            points[:, 2] = 0.0
    points = points[:count]
    camera = points @ R.T + t
    image = camera @ K.T
    return Scene(points, image[:, :2] / image[:, 2:], K, R, t, diameter)


def stack(scenes: list[Scene], dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image points, model points, intrinsics and validity, padded with garbage."""
    width = max(len(s.points_model) for s in scenes)
    image = torch.full((len(scenes), width, 2), 123.0, dtype=dtype)
    model = torch.full((len(scenes), width, 3), -7.0, dtype=dtype)
    valid = torch.zeros(len(scenes), width, dtype=torch.bool)
    for i, scene in enumerate(scenes):
        n = len(scene.points_model)
        image[i, :n] = torch.from_numpy(scene.points_image).to(dtype)
        model[i, :n] = torch.from_numpy(scene.points_model).to(dtype)
        valid[i, :n] = True
    K = torch.from_numpy(np.stack([s.K for s in scenes])).to(dtype)
    return image, model, K, valid


def pose_errors(T: Tensor, scenes: list[Scene]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation errors in degrees, and translation errors relative to the distance."""
    poses = T.detach().double().numpy()
    R = np.stack([s.R for s in scenes])
    t = np.stack([s.t for s in scenes])
    chord = np.linalg.norm(poses[:, :3, :3] - R, axis=(1, 2)) / np.sqrt(8.0)
    angle = np.degrees(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0)))
    return angle, np.linalg.norm(poses[:, :3, 3] - t, axis=1) / np.linalg.norm(t, axis=1)

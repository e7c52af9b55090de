"""Smooth feature maps that look the same from everywhere: alignment problems with a known pose."""

import math

import numpy as np
import torch
from torch import Tensor

from foundpose.geometry import PatchGrid
from foundpose.geometry.transforms import make_transform, se3_exp, transform_points
from foundpose.refinement import AlignmentProblem, FeatureMaps, sample_features

SIZE, STRIDE, OFFSET = 140, 14.0, 6.5
GRID = PatchGrid(STRIDE, OFFSET, 10)


def true_pose(dtype: torch.dtype = torch.float64) -> Tensor:
    """An object of about 70 units that fills most of a crop of 140 px."""
    R = se3_exp(torch.tensor([[0.0, 0, 0, 0.4, -0.7, 0.2]], dtype=torch.float64))[0, :3, :3]
    return make_transform(R, torch.tensor([4.0, -3.0, 600.0], dtype=torch.float64)).to(dtype)


def intrinsics(dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor([[600.0, 0, 69.5], [0, 600.0, 69.5], [0, 0, 1]], dtype=dtype)


def smooth_map(channels: int, norm: float, seed: int, grid: int = 10) -> Tensor:
    """(grid, grid, channels), a sum of waves that are a few cells long."""
    rng = np.random.default_rng(seed)
    direction = torch.from_numpy(rng.normal(size=(2, channels)) * 0.45)
    phase = torch.from_numpy(rng.uniform(0, 2 * math.pi, channels))
    row, column = torch.meshgrid(torch.arange(grid).double(), torch.arange(grid).double(), indexing="ij")
    angle = torch.stack([column, row], dim=-1) @ direction + phase
    return norm * math.sqrt(2 / channels) * torch.cos(angle)


def make_problem(
    n: int = 2,
    points: int = 40,
    channels: int = 16,
    norm: float = 5.0,
    noise: float = 0.05,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> tuple[AlignmentProblem, Tensor]:
    """n alignment problems whose descriptors are the maps' own at the true pose, with noise; and that pose."""
    rng = np.random.default_rng(seed)
    features = torch.stack([smooth_map(channels, norm, seed + k) for k in range(n)])
    x = torch.from_numpy(rng.uniform(-36, 36, (n, points, 3)))
    T, K = true_pose().expand(n, 4, 4), intrinsics().expand(n, 3, 3)
    camera = transform_points(T, x) @ K.mT
    pixels = camera[..., :2] / camera[..., 2:]
    index = torch.arange(n)
    p = sample_features(features, index, (pixels - OFFSET) / STRIDE, "bicubic")[..., 0, :]
    p = p + noise * torch.from_numpy(rng.normal(size=p.shape))
    valid = torch.ones(n, points, dtype=torch.bool)
    problem = AlignmentProblem(FeatureMaps(features, GRID, SIZE), index, K, p, x, valid)
    return cast(problem, dtype), T.to(dtype)


def cast(problem: AlignmentProblem, dtype: torch.dtype) -> AlignmentProblem:
    moved = {
        n: x.to(dtype) for n, x in problem._asdict().items() if n in ("K", "descriptors", "points_model")
    }
    return with_maps(problem, problem.maps.values.to(dtype))._replace(**moved)


def with_maps(problem: AlignmentProblem, values: Tensor) -> AlignmentProblem:
    """The same problem with other feature maps (m, h, w, d)."""
    return problem._replace(maps=problem.maps._replace(values=values))


def perturb(T: Tensor, degrees: float, distance: float, seed: int = 0) -> Tensor:
    """Turned about the object's origin and moved, in random directions."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(len(T), 3))
    axis *= math.radians(degrees) / np.linalg.norm(axis, axis=1, keepdims=True)
    step = rng.normal(size=(len(T), 3))
    step *= distance / np.linalg.norm(step, axis=1, keepdims=True)
    twist = torch.from_numpy(np.concatenate([np.zeros_like(axis), axis], axis=1)).to(T.dtype)
    R = se3_exp(twist)[:, :3, :3]
    return make_transform(R @ T[:, :3, :3], T[:, :3, 3] + torch.from_numpy(step).to(T.dtype))

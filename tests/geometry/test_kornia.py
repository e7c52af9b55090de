"""What stands in for an operation of kornia's equals it; and the example of docs/kornia.md runs."""

import re
from pathlib import Path

import torch
from kornia.geometry.camera import project_points as kornia_project_points
from kornia.geometry.liegroup import Se3
from kornia.geometry.linalg import inverse_transformation
from kornia.geometry.linalg import transform_points as kornia_transform_points

from foundpose.geometry import (
    intrinsics_matrix,
    invert_transform,
    project_points,
    se3_exp,
    transform_points,
)

DOCS = Path(__file__).resolve().parents[2] / "docs"


def motions():
    twists = torch.randn(7, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return twists, se3_exp(twists)


def test_exponential_map():
    twists, T = motions()
    torch.testing.assert_close(T, Se3.exp(twists).matrix(), atol=1e-12, rtol=1e-12)


def test_motions_of_points():
    _, T = motions()
    points = torch.randn(7, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(transform_points(T, points), kornia_transform_points(T, points))
    torch.testing.assert_close(invert_transform(T), inverse_transformation(T))


def test_projection():
    points = torch.randn(7, 20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points[..., 2] += 10.0
    K = intrinsics_matrix(600.0, 610.0, 320.0, 240.0).double().expand(7, 3, 3)
    pixels, depth = project_points(points, K)
    torch.testing.assert_close(pixels, kornia_project_points(points, K[:, None]))
    assert torch.equal(depth, points[..., 2])


def test_the_example_runs():
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "kornia.md").read_text(), re.DOTALL)
    names = {}
    exec(code, names)
    assert names["photo"].grad.abs().sum() > 0
    torch.testing.assert_close(names["T"], names["crops"].T_crop_from_camera, atol=1e-5, rtol=0)

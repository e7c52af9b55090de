"""Operations of this library beside kornia's: their times in one run, as a Markdown table.

python experiments/kornia_times.py
"""

import statistics
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from kornia.geometry.camera import project_points as kornia_project_points
from kornia.geometry.liegroup import Se3
from kornia.geometry.linalg import transform_points as kornia_transform_points
from kornia.geometry.transform import pyrdown, warp_perspective
from torch import Tensor

from foundpose.geometry import (
    intrinsics_matrix,
    project_points,
    se3_exp,
    transform_points,
)
from foundpose.geometry.warp import sample_pixels, warped_pixels

_REPEATS = 31


def main() -> None:
    """Measure and print."""
    torch.manual_seed(0)
    twists = 0.1 * torch.randn(80, 6)
    T = se3_exp(twists)
    T[:, 2, 3] += 10.0
    points = torch.randn(80, 300, 3)
    camera = transform_points(T, points)
    K = intrinsics_matrix(600.0, 600.0, 210.0, 210.0).expand(80, 3, 3)
    image = torch.rand(4, 3, 480, 640)
    H = torch.eye(3).repeat(4, 1, 1)
    H[:, 0, 0] = H[:, 1, 1] = 2.0
    H[:, 0, 2], H[:, 1, 2], H[:, 2, 0] = -300.0, -200.0, 1e-4
    rows: list[tuple[str, Callable[[], object], Callable[[], object]]] = [
        (
            "warp of 4 pictures to 420 px: positions and `remap` | `warp_perspective`",
            lambda: sample_pixels(image, warped_pixels(H, 420)),
            lambda: warp_perspective(image, H, (420, 420), align_corners=True),
        ),
        (
            "next level of a pyramid: `avg_pool2d` | `pyrdown` (another filter)",
            lambda: F.avg_pool2d(image, 2, ceil_mode=True, count_include_pad=False),
            lambda: pyrdown(image),
        ),
        (
            "exponential map of 80 twists: `se3_exp` | `Se3.exp(...).matrix()`",
            lambda: se3_exp(twists),
            lambda: Se3.exp(twists).matrix(),
        ),
        (
            "80 × 300 points moved: `transform_points` | kornia's",
            lambda: transform_points(T, points),
            lambda: kornia_transform_points(T, points),
        ),
        (
            "80 × 300 points projected: `project_points` | kornia's",
            lambda: project_points(camera, K),
            lambda: _kornia_pixels(camera, K),
        ),
    ]
    print("| operation: ours, kornia's | ours | kornia's | ratio |\n|---|---|---|---|")
    for name, ours, theirs in rows:
        mine, other = times(ours, theirs)
        name = name.replace(" | ", ", ")
        print(f"| {name} | {1e3 * mine:.3g} ms | {1e3 * other:.3g} ms | {other / mine:.2f} |")


def times(first: Callable[[], object], second: Callable[[], object]) -> tuple[float, float]:
    """Median seconds of two functions, called in turn."""
    spent: tuple[list[float], list[float]] = ([], [])
    for repeat in range(_REPEATS + 3):
        for run, into in zip((first, second), spent, strict=True):
            start = time.perf_counter()
            run()
            if repeat >= 3:
                into.append(time.perf_counter() - start)
    return statistics.median(spent[0]), statistics.median(spent[1])


def _kornia_pixels(camera: Tensor, K: Tensor) -> Tensor:
    return kornia_project_points(camera, K[:, None])


if __name__ == "__main__":
    main()

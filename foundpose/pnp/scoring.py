"""Quality of many poses by the reprojection errors of their correspondences."""

from collections.abc import Sequence

import torch
from torch import Tensor

from foundpose.pnp.problem import PnpProblem

# Numbers of a buffer that stays in a core's cache.
_CPU_NUMBERS_PER_BLOCK = 1 << 16


def score_poses(T: Tensor, problem: PnpProblem, threshold: float) -> Tensor:
    """Quality of several poses per problem: the inlier count, plus a fraction that grows as errors shrink.

    Args:
        T: (B, S, 4, 4) poses.
        problem: B problems; what is not valid does not count.
        threshold: pixels.

    Returns:
        (B, S) qualities; their integer part is the count. Not differentiable: give it detached tensors.
    """
    # The hottest loop of RANSAC: few passes over (B, S, N) numbers, in place. Masks are numbers, as comparisons to
    # bool and masked writes take a CPU ten times as long. Products are written out for the reason given in
    # :func:`~foundpose.pnp.cost.reprojection_errors`.
    points = problem.points_model.transpose(1, 2).contiguous().unsqueeze(2).unbind(1)
    observed = problem.points_image.transpose(1, 2).contiguous().unsqueeze(2).unbind(1)
    counts = problem.valid.unsqueeze(1).to(T.dtype)
    rows = T.shape[1]
    if T.device.type == "cpu":
        rows = max(1, _CPU_NUMBERS_PER_BLOCK // max(1, counts.numel()))
    parts = points, observed, counts, threshold
    return torch.cat([_score_block(M, *parts) for M in _projections(T, problem.K).split(rows, dim=1)], dim=1)


def _score_block(
    projections: Tensor,
    points: Sequence[Tensor],
    observed: Sequence[Tensor],
    valid: Tensor,
    threshold: float,
) -> Tensor:
    """Qualities (B, S); coordinates of points and pixels, and the mask as numbers, are (B, 1, N) each."""
    buffer = projections.new_empty(*projections.shape[:2], valid.shape[-1])
    u, v, depth = (_affine(row, points) for row in projections.unbind(2))
    for line, coordinate in zip((u, v), observed, strict=True):
        line.addcmul_(depth, coordinate, value=-1.0)
    ahead = torch.gt(depth, 0.0, out=buffer)
    squared = u.square_().addcmul_(v, v).div_(depth.square_().clamp_(min=torch.finfo(buffer.dtype).tiny))
    inliers = torch.le(squared, threshold**2, out=v).mul_(ahead).mul_(valid)
    count = inliers.sum(-1)
    mean = squared.clamp_(max=threshold**2).mul_(inliers).sum(-1) / count.clamp(min=1)
    # Where numbers overflow there is no mean; such points are no inliers.
    return count + 0.5 * (1.0 - (mean / threshold**2).nan_to_num(nan=1.0))


def _projections(T: Tensor, K: Tensor) -> Tensor:
    """Matrices (B, S, 3, 4) that give pixel coordinates times depth, and depth."""
    x, y, z = (K[:, None, :, :, None] * T[:, :, None, :3]).unbind(3)
    return x + y + z


def _affine(row: Tensor, points: Sequence[Tensor]) -> Tensor:
    """``row`` (B, S, 4) times homogeneous points, coordinates (B, 1, N) each: (B, S, N)."""
    x, y, z, shift = row.split(1, dim=-1)
    return (x * points[0]).addcmul_(y, points[1]).addcmul_(z, points[2]).add_(shift)

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
    parts = points, observed, problem.K, counts, threshold
    return torch.cat([_score_block(block, *parts) for block in T.split(rows, dim=1)], dim=1)


def _score_block(
    T: Tensor,
    points: Sequence[Tensor],
    observed: Sequence[Tensor],
    K: Tensor,
    valid: Tensor,
    threshold: float,
) -> Tensor:
    """Qualities (B, S); coordinates of points and pixels, and the mask as numbers, are (B, 1, N) each."""
    buffer = torch.empty(*T.shape[:2], valid.shape[-1], dtype=T.dtype, device=T.device)
    depth, u, v = (_affine(row, points, buffer) for row in _projection_rows(T, K))
    for line, coordinate in zip((u, v), observed, strict=True):
        line.sub_(torch.mul(depth, coordinate, out=buffer))
    ahead = torch.gt(depth, 0.0, out=buffer)
    squared = u.square_().addcmul_(v, v).div_(depth.square_().clamp_(min=torch.finfo(T.dtype).tiny))
    inliers = torch.le(squared, threshold**2, out=v).mul_(ahead).mul_(valid)
    count = inliers.sum(-1)
    mean = squared.clamp_(max=threshold**2).mul_(inliers).sum(-1) / count.clamp(min=1)
    # Where numbers overflow there is no mean; such points are no inliers.
    return count + 0.5 * (1.0 - (mean / threshold**2).nan_to_num(nan=1.0))


def _projection_rows(T: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (B, S, 4) of the projection that give depth, and pixel coordinates times depth."""
    x, y, z = T[..., 0, :], T[..., 1, :], T[..., 2, :]
    M = K[:, None, :, :, None]
    u = M[:, :, 0, 0] * x + M[:, :, 0, 1] * y + M[:, :, 0, 2] * z
    v = M[:, :, 1, 0] * x + M[:, :, 1, 1] * y + M[:, :, 1, 2] * z
    return z, u, v


def _affine(row: Tensor, points: Sequence[Tensor], buffer: Tensor) -> Tensor:
    """``row`` (B, S, 4) times homogeneous points, coordinates (B, 1, N) each: (B, S, N)."""
    total = row[..., 0:1] * points[0]
    for i in (1, 2):
        total.add_(torch.mul(row[..., i : i + 1], points[i], out=buffer))
    return total.add_(row[..., 3:])

"""Quality of poses by the reprojection errors of their correspondences."""

from collections.abc import Sequence

import torch
from torch import Tensor

from foundpose.optimization.robust import RobustLoss

# Numbers of a buffer that stays in a core's cache.
_CPU_NUMBERS_PER_BLOCK = 1 << 16


def score_poses(
    T: Tensor, points_image: Tensor, points_model: Tensor, K: Tensor, valid: Tensor, threshold: float
) -> Tensor:
    """Quality of several poses per problem: the inlier count, plus a fraction that grows as errors shrink.

    Args:
        T: (B, S, 4, 4) poses.
        points_image: (B, N, 2) pixels.
        points_model: (B, N, 3).
        K: (B, 3, 3).
        valid: (B, N) bool.
        threshold: pixels.

    Returns:
        (B, S) qualities; their integer part is the count. Not differentiable: give it detached tensors.
    """
    # The hottest loop of RANSAC: few passes over (B, S, N) numbers, in place. Masks are numbers, as comparisons to
    # bool and masked writes take a CPU ten times as long. Products are written out for the reason given in
    # :func:`reprojection_errors`.
    points = points_model.transpose(1, 2).contiguous().unsqueeze(2).unbind(1)
    observed = points_image.transpose(1, 2).contiguous().unsqueeze(2).unbind(1)
    counts = valid.unsqueeze(1).to(T.dtype)
    rows = T.shape[1]
    if T.device.type == "cpu":
        rows = max(1, _CPU_NUMBERS_PER_BLOCK // max(1, valid.numel()))
    blocks = [_score_block(block, points, observed, K, counts, threshold) for block in T.split(rows, dim=1)]
    return torch.cat(blocks, dim=1)


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


def select_inliers(
    T: Tensor,
    points_image: Tensor,
    points_model: Tensor,
    K: Tensor,
    valid: Tensor,
    threshold: float,
    weights: Tensor | None = None,
    loss: RobustLoss | None = None,
) -> tuple[Tensor, Tensor]:
    """Inliers (B, N) of one pose (B, 4, 4) per problem, and its truncated cost (B,) in px²; constants.

    The truncated cost counts an inlier by its loss and all others by the loss at the threshold. The polish on
    the inliers never raises it, while it may well lose an inlier of a pose that was chosen for having many:
    the winner of hundreds of samples tends to bend towards a few outliers.
    """
    squared, depth = reprojection_errors(T.detach(), points_image.detach(), points_model.detach(), K.detach())
    inliers = (squared <= threshold**2) & (depth > 0) & valid
    truncated = torch.where(inliers, squared, torch.full_like(squared, threshold**2))
    cost = truncated if loss is None else loss(truncated)[0].detach()
    return inliers, (cost if weights is None else cost * weights.detach()).sum(-1)


def reprojection_errors(
    T: Tensor, points_image: Tensor, points_model: Tensor, K: Tensor
) -> tuple[Tensor, Tensor]:
    """Squared pixel distances and depths of projected points.

    Products and sums are written out: matrix routines may round differently for another amount of padding or
    another batch size, which could turn an inlier at the threshold into an outlier.

    Args:
        T: (..., 4, 4) poses.
        points_image: (..., N, 2) pixels.
        points_model: (..., N, 3).
        K: (..., 3, 3); leading dimensions broadcast.

    Returns:
        Squared distances (..., N), px², and depths (..., N), mesh units. Where the depth is not positive the
        distance means nothing. Differentiable w.r.t. all tensors.
    """
    x, y, z = points_model.unbind(-1)
    R, t = T[..., :3, :3, None], T[..., :3, 3, None]
    x, y, depth = (
        R[..., i, 0, :] * x + R[..., i, 1, :] * y + R[..., i, 2, :] * z + t[..., i, :] for i in range(3)
    )
    inverse = 1.0 / torch.where(depth > 0, depth, torch.ones_like(depth))
    x, y = x * inverse, y * inverse
    M = K[..., None]
    u = M[..., 0, 0, :] * x + M[..., 0, 1, :] * y + (M[..., 0, 2, :] - points_image[..., 0])
    v = M[..., 1, 0, :] * x + M[..., 1, 1, :] * y + (M[..., 1, 2, :] - points_image[..., 1])
    return u * u + v * v, depth

"""Quality of poses by the reprojection errors of their correspondences."""

import torch
from torch import Tensor

from foundpose.optimization.robust import RobustLoss


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
        (B, S) qualities; their integer part is the count.
    """
    squared, depth = reprojection_errors(
        T, points_image.unsqueeze(1), points_model.unsqueeze(1), K.unsqueeze(1)
    )
    inliers = (squared <= threshold**2) & (depth > 0) & valid.unsqueeze(-2)
    count = inliers.sum(-1).to(squared.dtype)
    mean = torch.where(inliers, squared, torch.zeros_like(squared)).sum(-1) / count.clamp(min=1)
    return count + 0.5 * (1.0 - mean / threshold**2)


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

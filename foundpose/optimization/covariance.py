"""The covariance of an optimised pose."""

import torch
from kornia.geometry.conversions import vector_to_skew_symmetric_matrix
from torch import Tensor

from foundpose.optimization.cholesky import scaled_cholesky
from foundpose.optimization.local_frame import LocalFrame


def residual_variance(energy: Tensor, freedom: Tensor) -> Tensor:
    """Variance (B,) of a residual of weight one; infinite where the residuals leave nothing to estimate it from.

    Args:
        energy: (B,) weighted sum of squared residuals.
        freedom: (B,) number of residuals that count, less the six unknowns.
    """
    return torch.where(freedom > 0.5, energy / freedom.clamp(min=0.5), torch.inf)


def pose_covariance(H: Tensor, variance: Tensor, frame: LocalFrame) -> Tensor:
    """Inverse of the Gauss-Newton matrix, moved to the camera frame and scaled by the variance of the noise.

    Args:
        H: (B, 6, 6) Gauss-Newton matrix in the local frame.
        variance: (B,) of a residual of weight one; infinite where it is not known.
        frame: where the local frame lies.

    Returns:
        (B, 6, 6) covariance of the left twist (v, ω) in the camera frame, mesh units and radians; infinite where the
        variance is, or where H does not determine the pose. A constant for autograd.
    """
    H, variance, origin, size = (x.detach() for x in (H, variance, frame.origin, frame.size))
    system = scaled_cholesky(H, H.diagonal(dim1=-2, dim2=-1))
    # v at the local origin is size v + origin × ω at the camera's.
    identity = torch.eye(3, dtype=H.dtype, device=H.device).expand(len(H), 3, 3)
    cross = vector_to_skew_symmetric_matrix(origin)
    upper = torch.cat([size.unsqueeze(-1) * identity, cross], dim=-1)
    to_camera = torch.cat([upper, torch.cat([torch.zeros_like(cross), identity], dim=-1)], dim=-2)
    covariance = variance[:, None, None] * (to_camera @ system.inverse() @ to_camera.transpose(-1, -2))
    unknown = torch.diag_embed(torch.full_like(H[:, 0], torch.inf))
    return torch.where((system.usable & torch.isfinite(variance))[:, None, None], covariance, unknown)

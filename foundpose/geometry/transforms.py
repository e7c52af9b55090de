"""Rigid transformations as (..., 4, 4) matrices.

``T_b_from_a`` maps points of frame ``a`` to frame ``b``. Twists are ``(v, ω)`` and act from the left:
``T ← se3_exp(δ) @ T``.
"""

import math

import torch
from kornia.geometry.linalg import inverse_transformation
from torch import Tensor


def make_transform(R: Tensor, t: Tensor) -> Tensor:
    """Stack rotations and translations into homogeneous matrices.

    Args:
        R: (..., 3, 3) rotations.
        t: (..., 3) translations, any length unit.

    Returns:
        (..., 4, 4) transformations.

    Differentiable w.r.t. both arguments.
    """
    if R.shape[-2:] != (3, 3) or t.shape[-1] != 3:
        raise ValueError(f"R and t must end in (3, 3) and (3,), got {tuple(R.shape)} and {tuple(t.shape)}")
    top = torch.cat([R, t.unsqueeze(-1).expand(*R.shape[:-1], 1)], dim=-1)
    # Made on the device: a tensor from Python numbers would wait for it.
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def invert_transform(T: Tensor) -> Tensor:
    """Invert rigid transformations: (..., 4, 4) → (..., 4, 4). Differentiable w.r.t. ``T``."""
    return inverse_transformation(T.reshape(-1, 4, 4)).reshape(T.shape)


def transform_points(T_b_from_a: Tensor, points_a: Tensor) -> Tensor:
    """Map points from frame a to frame b.

    Args:
        T_b_from_a: (..., 4, 4).
        points_a: (..., N, 3), leading dimensions broadcast with those of ``T_b_from_a``.

    Returns:
        (..., N, 3) points in frame b. Differentiable w.r.t. both arguments.
    """
    return points_a @ T_b_from_a[..., :3, :3].transpose(-1, -2) + T_b_from_a[..., None, :3, 3]


def se3_exp(twist: Tensor) -> Tensor:
    """Exponential map of SE(3): twists (..., 6) as ``(v, ω)`` → (..., 4, 4).

    Differentiable w.r.t. ``twist`` everywhere, the identity included, in reverse and forward mode.
    """
    if twist.shape[-1] != 6:
        raise ValueError(f"twist must have shape (..., 6), got {tuple(twist.shape)}")
    # Written out, where kornia's So3 takes six times as many operations: optimisers call this in every step. The
    # series of exp(X) ends: X⁴ = −θ² X² for a twist's matrix X, so I + X + B X² + C X³ is all of it. The product
    # of ω's skew-symmetric matrix with another is the cross product with its columns.
    v, w = twist.unsqueeze(-1).split(3, dim=-2)
    identity = torch.eye(4, dtype=twist.dtype, device=twist.device).expand(*twist.shape[:-1], 4, 4)
    top, bottom = identity.split([3, 1], dim=-2)
    first = torch.linalg.cross(w, top, dim=-2)
    first[..., 3:] += v
    second = torch.linalg.cross(w, first, dim=-2)
    third = torch.linalg.cross(w, second, dim=-2)
    # What B and C change below an angle of ∛(24 ε) is less than rounding; there they count as constants, which keeps
    # their derivatives finite.
    least = (24.0 * torch.finfo(twist.dtype).eps) ** (2.0 / 3.0)
    squared = w.square().sum(-2, keepdim=True).clamp(min=least)
    angle = squared.sqrt()
    B = 0.5 * torch.sinc(angle / (2.0 * math.pi)).square()  # (1 − cos θ) / θ²
    C = (1.0 - torch.sinc(angle / math.pi)) / squared  # (θ − sin θ) / θ³
    moved = torch.addcmul(torch.addcmul(top + first, B, second), C, third)
    return torch.cat([moved, bottom], dim=-2)


def rotation_angle(R_a: Tensor, R_b: Tensor) -> Tensor:
    """Geodesic distance between rotations: two (..., 3, 3) → (...) in radians, accurate near 0 and π.

    Differentiable w.r.t. both arguments; at its kinks, 0 and π, the gradient is a finite subgradient (zero where
    the product of the rotations is exactly symmetric).
    """
    R = R_a.transpose(-1, -2) @ R_b
    axis = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], dim=-1
    )
    return torch.atan2(torch.linalg.vector_norm(axis, dim=-1), R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)


def project_to_rotation(M: Tensor) -> Tensor:
    """Nearest rotation in the Frobenius norm: (..., 3, 3) → (..., 3, 3), determinant +1.

    Differentiable (once) w.r.t. ``M`` wherever the nearest rotation is unique, so at rotations too. Elsewhere
    (rank below two, or a negative determinant and two equal smallest singular values) directions in which the
    rotation is not determined have gradient zero.
    """
    # Autograd of the SVD is NaN where singular values are equal, as they are for a rotation.
    U, S, Vh = torch.linalg.svd(M.detach())
    sign = torch.det(U @ Vh).sign()
    flip = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
    U, S = U * flip.unsqueeze(-2), S * flip
    if not M.requires_grad:
        return U @ Vh
    # With M = U S Vᵀ the rotation U Vᵀ turns by U Ω Vᵀ, Ω_ij = (Uᵀ dM V - (Uᵀ dM V)ᵀ)_ij / (s_i + s_j).
    inner = U.transpose(-1, -2) @ M @ Vh.transpose(-1, -2)
    total = S.unsqueeze(-1) + S.unsqueeze(-2)
    smallest = 8.0 * torch.finfo(S.dtype).eps * S[..., :1, None]
    turn = (inner - inner.transpose(-1, -2)) / total.where(total > smallest, torch.inf)
    # The value is zero but for rounding; only its derivative is wanted.
    return U @ Vh + U @ (turn - turn.detach()) @ Vh

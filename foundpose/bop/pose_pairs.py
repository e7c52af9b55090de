"""Checks of the arguments of pose errors, and harmless stand-ins for poses that are not finite."""

import torch
from torch import Tensor


def check_model(vertices: Tensor, symmetries: Tensor | None) -> None:
    """Raise ValueError unless vertices are (V, 3), symmetries (S, 4, 4), none empty, and of one dtype and device."""
    if vertices.dim() != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise ValueError(f"vertices must be (V, 3) with V at least 1, got {tuple(vertices.shape)}")
    if vertices.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"vertices must be float32 or float64, got {vertices.dtype}")
    if symmetries is not None:
        if symmetries.dim() != 3 or symmetries.shape[1:] != (4, 4) or len(symmetries) == 0:
            raise ValueError(
                f"symmetries must be (S, 4, 4), the identity among them, got {tuple(symmetries.shape)}"
            )
        _check_like("symmetries", symmetries, vertices)


def check_pairs(
    T_est: Tensor, T_true: Tensor, vertices: Tensor, symmetries: Tensor | None = None, K: Tensor | None = None
) -> None:
    """As :func:`check_model`, and that poses are (B, 4, 4) and K is (B, 3, 3) or (1, 3, 3)."""
    check_model(vertices, symmetries)
    if T_est.dim() != 3 or T_est.shape[1:] != (4, 4) or T_true.shape != T_est.shape:
        raise ValueError(
            f"T_est and T_true must be (B, 4, 4), one true pose for each estimate, got {tuple(T_est.shape)} "
            f"and {tuple(T_true.shape)}"
        )
    _check_like("T_est", T_est, vertices)
    _check_like("T_true", T_true, vertices)
    if K is not None:
        if K.shape not in ((len(T_est), 3, 3), (1, 3, 3)):
            raise ValueError(f"K must be (B, 3, 3) or (1, 3, 3) with B = {len(T_est)}, got {tuple(K.shape)}")
        _check_like("K", K, vertices)


def _check_like(name: str, value: Tensor, vertices: Tensor) -> None:
    if value.dtype != vertices.dtype or value.device != vertices.device:
        raise ValueError(
            f"{name} must be {vertices.dtype} on {vertices.device} like the vertices, got {value.dtype} on "
            f"{value.device}"
        )


def finite_poses(T_est: Tensor, T_true: Tensor, K: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """(B, 3, 4) matrices, with harmless ones where a pose or K is not finite, and (B,) whether it is."""
    est, true = T_est[:, :3], T_true[:, :3]
    finite = torch.isfinite(est).all(dim=(1, 2)) & torch.isfinite(true).all(dim=(1, 2))
    if K is not None:
        finite = finite & torch.isfinite(K).all(dim=(1, 2))
    # Maps everything to depth 1, so that nothing overflows and gradients of shared arguments stay clean.
    harmless = est.new_tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    keep = finite[:, None, None]
    return torch.where(keep, est, harmless), torch.where(keep, true, harmless), finite

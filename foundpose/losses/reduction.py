"""What all losses share: norms, masks, checks and the reduction over the batch."""

from typing import Literal, get_args

import torch
from torch import Tensor, nn

Norm = Literal["l1", "l2", "squared"]
Reduction = Literal["none", "mean", "sum"]


def check_choice(name: str, value: str, choices: object) -> None:
    """Raise ``ValueError`` unless ``value`` is one of a Literal's values."""
    if value not in get_args(choices):
        raise ValueError(f"{name} must be one of {', '.join(get_args(choices))}, got {value!r}")


def check_poses(T_est: Tensor, T_true: Tensor, valid: Tensor | None, sizes: tuple[int, ...] = (4,)) -> None:
    """Raise ``ValueError`` unless poses and mask agree in shape, dtype and device."""
    size = T_est.shape[-1] if T_est.dim() == 3 else 0
    if T_est.dim() != 3 or size not in sizes or T_est.shape[1] != size or T_true.shape != T_est.shape:
        shapes = " or ".join(f"(B, {n}, {n})" for n in sizes)
        raise ValueError(
            f"T_est and T_true must both have shape {shapes}, got {tuple(T_est.shape)} and {tuple(T_true.shape)}"
        )
    if not T_est.is_floating_point():
        raise ValueError(f"T_est must be floating point, got {T_est.dtype}")
    check_like("T_true", T_true, T_est)
    if valid is not None and (valid.shape != T_est.shape[:1] or valid.dtype != torch.bool):
        raise ValueError(
            f"valid must be ({len(T_est)},) bool, one for each pose, got {tuple(valid.shape)} {valid.dtype}"
        )


def check_points(points_model: Tensor, T_est: Tensor) -> Tensor:
    """Return model points as (B, M, 3) or (1, M, 3); raise ``ValueError`` for any other shape."""
    if points_model.dim() == 2:
        points_model = points_model[None]
    shape = tuple(points_model.shape)
    if len(shape) != 3 or shape[0] not in (1, len(T_est)) or shape[1] < 1 or shape[2] != 3:
        raise ValueError(
            f"points_model must have shape ({len(T_est)}, M, 3) or (M, 3), M at least 1, got {shape}"
        )
    check_like("points_model", points_model, T_est)
    return points_model


def check_like(name: str, value: Tensor, T_est: Tensor) -> None:
    """Raise ``ValueError`` unless dtype and device are those of the poses."""
    if value.dtype != T_est.dtype or value.device != T_est.device:
        raise ValueError(
            f"{name} must be {T_est.dtype} on {T_est.device} as T_est, got {value.dtype} on {value.device}"
        )


def place_points(T: Tensor, points: Tensor) -> Tensor:
    """Points (B, M, 3) or (1, M, 3) under N poses each, (B, N, 4, 4) → (B, N, 3, M).

    One product per sample, coordinates first: several times faster than points last, and the points are not copied
    for each pose.
    """
    rows = T[..., :3, :3].flatten(1, 2) @ points.mT
    return rows.unflatten(1, (T.shape[1], 3)) + T[..., :3, 3:]


def mean_norm(displacements: Tensor, norm: Norm) -> Tensor:
    """Mean norm of M displacements: (..., C, M) → (...); the gradient of a displacement of zero is zero."""
    if norm == "l1":
        return displacements.abs().sum(-2).mean(-1)
    squared = displacements.square().sum(-2)
    if norm == "squared":
        return squared.mean(-1)
    # As vector_norm, which takes sixty times as long over this dimension.
    still = squared == 0
    root = torch.where(still, torch.ones_like(squared), squared).sqrt()
    return torch.where(still, torch.zeros_like(root), root).mean(-1)


def keep_valid(valid: Tensor | None, value: Tensor, neutral: Tensor) -> Tensor:
    """Put ``neutral`` in the place of the samples that do not count.

    Done before anything is computed with them, so that no NaN of theirs is ever multiplied with a zero gradient.
    """
    if valid is None or value.shape[0] != valid.shape[0]:
        return value
    return torch.where(valid.view(-1, *[1] * (value.dim() - 1)), value, neutral)


class PoseLoss(nn.Module):
    """An error for each pose, reduced over the batch.

    Args:
        reduction: "none" for (B,), "mean" over the valid samples or "sum".
        norm: of displacements, where there are any.

    Raises:
        ValueError: an unknown setting.
    """

    def __init__(self, reduction: Reduction, norm: Norm = "l1") -> None:
        super().__init__()
        check_choice("norm", norm, Norm)
        check_choice("reduction", reduction, Reduction)
        self.norm: Norm = norm
        self.reduction: Reduction = reduction

    def reduce(self, errors: Tensor, valid: Tensor | None) -> Tensor:
        """Reduce errors (B,); the mean is over the valid samples, and 0 where there is none."""
        if self.reduction == "none":
            return errors
        if self.reduction == "sum":
            return errors.sum()
        return errors.sum() / (max(len(errors), 1) if valid is None else valid.sum().clamp(min=1))

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"norm={self.norm!r}, reduction={self.reduction!r}"

"""Angle between the estimated and the true rotation."""

import torch
from torch import Tensor

from foundpose.geometry.symmetries import Symmetries, nearest_axis_angles
from foundpose.geometry.transforms import make_transform, rotation_angle
from foundpose.losses.alignment import best_symmetry
from foundpose.losses.reduction import PoseLoss, Reduction, check_poses, keep_valid


def geodesic_rotation_error(
    T_est: Tensor, T_true: Tensor, symmetries: Symmetries | None = None, valid: Tensor | None = None
) -> Tensor:
    """Angle between rotations, the least over the object's symmetries.

    The angle about the axis of a continuous symmetry is exact (closed form).

    Args:
        T_est: (B, 4, 4) estimated poses, or (B, 3, 3) rotations.
        T_true: true ones, of the same shape; rotations may be scaled (BOP's are, by up to 1.005).
        symmetries: :class:`Symmetries` of the B objects, of which the rotations count; None for none.
        valid: (B,) bool; the error of a sample that is not valid is 0, with zero gradient, whatever its poses hold.

    Returns:
        (B,) radians in [0, π], accurate near both ends.

    Raises:
        ValueError: shapes, dtypes or devices disagree.

    Differentiable w.r.t. the rotations and the symmetries' transforms and axes, wherever the best symmetry is
    unique; its choice counts as a constant. The gradient is finite everywhere, and zero at the kinks 0 and π.
    """
    check_poses(T_est, T_true, valid, sizes=(3, 4))
    eye = torch.eye(3, dtype=T_est.dtype, device=T_est.device)
    R_est = keep_valid(valid, T_est[:, :3, :3], eye)
    R_true = keep_valid(valid, T_true[:, :3, :3], eye)
    if symmetries is not None:
        symmetries.check(len(T_est), T_est)
        turns = symmetries._replace(
            transforms=_without_translation(symmetries.transforms[..., :3, :3]),
            origins=torch.zeros_like(symmetries.origins),
        )
        a, b = R_est.detach(), R_true.detach()
        S = best_symmetry(
            lambda S: rotation_angle(_unit_scale(a)[:, None], _unit_scale(b)[:, None] @ S[..., :3, :3]),
            turns,
            nearest_axis_angles(
                _without_translation(a),
                _without_translation(b),
                turns.detach(),
                torch.zeros_like(eye[:1]),
                eye[None],
            ),
            refine=False,
        )
        R_true = R_true @ keep_valid(valid, S[:, :3, :3], eye)
    angles = rotation_angle(_unit_scale(R_est), _unit_scale(R_true))
    return keep_valid(valid, angles, torch.zeros_like(angles))


def _unit_scale(R: Tensor) -> Tensor:
    """Take a common scale out of matrices (..., 3, 3)."""
    return R / torch.linalg.det(R)[..., None, None].clamp(min=torch.finfo(R.dtype).eps) ** (1 / 3)


def _without_translation(R: Tensor) -> Tensor:
    return make_transform(R, torch.zeros_like(R[..., 0]))


class GeodesicRotationLoss(PoseLoss):
    """Angle in radians between estimated and true rotation; see :func:`geodesic_rotation_error`.

    Args:
        reduction: "none" for (B,), "mean" over the valid samples or "sum".
    """

    def __init__(self, reduction: Reduction = "none") -> None:
        super().__init__(reduction)

    def forward(
        self, T_est: Tensor, T_true: Tensor, symmetries: Symmetries | None = None, valid: Tensor | None = None
    ) -> Tensor:
        """Loss (B,), or () if reduced; arguments as for :func:`geodesic_rotation_error`.

        Differentiable w.r.t. the same.
        """
        return self.reduce(geodesic_rotation_error(T_est, T_true, symmetries, valid), valid)

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"reduction={self.reduction!r}"

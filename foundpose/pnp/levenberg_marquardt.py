"""Poses at the optimum of the reprojection error, with gradient and covariance."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.optimization import Differentiation, LevenbergMarquardtResult, RobustLoss
from foundpose.optimization.cholesky import scaled_cholesky
from foundpose.optimization.implicit import check_differentiation
from foundpose.pnp.polish import LocalFrame, attach_pnp_gradient, polish_pnp, unit_weights
from foundpose.pnp.scoring import reprojection_errors


class PnpOptimum(NamedTuple):
    """Poses at the minimum of the reprojection error.

    Attributes:
        T_camera_from_model: (B, 4, 4), mesh units.
        covariance: (B, 6, 6) of the left twist (v, ω) in the camera frame, in mesh units and radians: the true pose
            is ``exp(δ) @ T`` with δ of this covariance. Infinite where the pose failed, where the points do not
            determine it, or (when the noise is estimated) leave nothing to estimate it from. A constant for autograd.
        cost: (B,) ``½ Σ w ρ`` at the minimum, px².
        initial_cost: (B,) cost at the initial pose, px²; infinite where a weighted point is behind the camera there.
        iterations: (B,) int64.
        converged: (B,) bool.
        failed: (B,) bool, the initial pose has a weighted point behind the camera, no point has weight, or some
            number is not finite; the pose comes back as it was.
        regular: (B,) bool, the pose has an implicit gradient; elsewhere (failed, or not determined by the points to
            the precision of the numbers) it is zero. Told in gradient mode only, all true without.
    """

    T_camera_from_model: Tensor
    covariance: Tensor
    cost: Tensor
    initial_cost: Tensor
    iterations: Tensor
    converged: Tensor
    failed: Tensor
    regular: Tensor


class LevenbergMarquardtPnp(nn.Module):
    """Weighted, robust PnP from an initial pose, by batched Levenberg-Marquardt on Gauss-Newton systems.

    Each sample has its own damping, acceptance and convergence. The gradient is by default that of the optimum
    (implicit function theorem): exact at convergence, and its memory does not grow with the iterations.

    Args:
        loss: robust loss ρ on squared pixel distances; None means least squares. A loss with parameters
            (``BarronLoss(learnable=True)``) gets their gradient.
        max_iterations: upper limit on the steps tried.
        tolerance: relative decrease of the cost that counts as converged; None means a few units of rounding.
        differentiation: "implicit", or "unrolled" through the steps taken (so that the initial pose has a gradient).
        noise: standard deviation of an image coordinate of weight one, in pixels, which scales the covariance; None
            estimates it from the residuals.

    Raises:
        ValueError: a setting out of range.

    Source: paper, section "Pose estimation from 2D-3D correspondences"; Chen et al., CVPR 2020 (implicit gradient).
    """

    def __init__(
        self,
        loss: RobustLoss | None = None,
        max_iterations: int = 20,
        tolerance: float | None = None,
        differentiation: Differentiation = "implicit",
        noise: float | None = None,
    ) -> None:
        super().__init__()
        if max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
        if tolerance is not None and not tolerance >= 0:
            raise ValueError(f"tolerance must not be negative, got {tolerance}")
        if noise is not None and not noise > 0:
            raise ValueError(f"noise must be positive (pixels) or None, got {noise}")
        check_differentiation(differentiation)
        self.loss = loss
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.differentiation: Differentiation = differentiation
        self.noise = noise

    def forward(
        self,
        T_camera_from_model: Tensor,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        weights: Tensor | None = None,
    ) -> PnpOptimum:
        """Optimise one pose per problem.

        Args:
            T_camera_from_model: (B, 4, 4) initial poses with every weighted point in front of the camera.
            points_image: (B, N, 2) pixels.
            points_model: (B, N, 3) mesh units.
            K: (B, 3, 3) intrinsics.
            weights: (B, N), not negative, or a bool mask; None means all ones. Points of weight zero are ignored.

        Returns:
            A :class:`PnpOptimum`.

        Raises:
            ValueError: shapes or dtypes do not fit.

        Differentiable w.r.t. ``points_image``, ``points_model``, ``K``, ``weights`` and the loss's parameters; in
        mode "unrolled" also w.r.t. the initial poses. ``T_camera_from_model`` and ``cost`` carry the gradient.
        Implicit gradients can be taken once (no second derivative). Where the points do not determine the pose they
        are zero. The weight of a point that is left out has none.
        """
        with torch.autocast(points_image.device.type, enabled=False):
            result, frame = self.optimise(T_camera_from_model, points_image, points_model, K, weights)
            weights = unit_weights(points_image) if weights is None else weights.to(points_image.dtype)
            covariance = self._covariance(
                result.failed,
                result.T.detach(),
                result.H.detach(),
                frame,
                points_image.detach(),
                points_model.detach(),
                K.detach(),
                weights.detach(),
            )
        return PnpOptimum(
            result.T,
            covariance,
            result.cost,
            result.initial_cost,
            result.iterations,
            result.converged,
            result.failed,
            result.regular & ~result.failed if torch.is_grad_enabled() else result.regular,
        )

    def optimise(
        self,
        T_camera_from_model: Tensor,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        weights: Tensor | None = None,
        tolerance: float | None = None,
        max_iterations: int | None = None,
    ) -> tuple[LevenbergMarquardtResult, LocalFrame]:
        """What :meth:`forward` does, without the covariance; see :func:`polish_pnp` for what is returned.

        ``tolerance`` takes the place of this module's own, and ``max_iterations`` lowers it.
        """
        return polish_pnp(
            T_camera_from_model,
            points_image,
            points_model,
            K,
            weights,
            loss=self.loss,
            max_iterations=min(self.max_iterations, max_iterations or self.max_iterations),
            tolerance=self.tolerance if tolerance is None else tolerance,
            differentiation=self.differentiation,
        )

    def attach_gradient(
        self,
        T_camera_from_model: Tensor,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        weights: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Give poses that this module has found (B, 4, 4) the implicit gradient, without touching their values, and
        say which have one (B,)."""
        return attach_pnp_gradient(T_camera_from_model, points_image, points_model, K, weights, self.loss)

    def _covariance(
        self,
        failed: Tensor,
        T: Tensor,
        H: Tensor,
        frame: LocalFrame,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        weights: Tensor,
    ) -> Tensor:
        """Inverse of the Gauss-Newton matrix, moved to the camera frame and scaled by the variance of the noise."""
        if self.noise is None:
            squared, depth = reprojection_errors(T, points_image, points_model, K)
            slope = torch.ones_like(squared) if self.loss is None else self.loss(squared)[1].detach()
            used = (weights > 0) & (depth > 0)
            share = torch.where(used, weights * slope, torch.zeros_like(slope))
            # Two equations a point, of which a robust loss counts but a part, against six unknowns.
            freedom = 2.0 * torch.where(used, slope, torch.zeros_like(slope)).sum(-1) - 6.0
            residual = torch.where(used, share * squared, torch.zeros_like(squared)).sum(-1)
            variance = residual / freedom.clamp(min=torch.finfo(freedom.dtype).eps)
            known = freedom > 0.5
        else:
            variance = torch.full_like(H[:, 0, 0], self.noise**2)
            known = torch.ones_like(variance, dtype=torch.bool)
        system = scaled_cholesky(H, H.diagonal(dim1=-2, dim2=-1))
        to_camera = frame.twist_to_camera()
        covariance = variance[:, None, None] * (to_camera @ system.inverse() @ to_camera.transpose(-1, -2))
        unknown = torch.diag_embed(torch.full_like(H[:, 0], torch.inf))
        return torch.where((known & system.usable & ~failed)[:, None, None], covariance, unknown)

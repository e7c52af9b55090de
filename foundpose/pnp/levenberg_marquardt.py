"""Poses at the optimum of the reprojection error, with gradient and covariance."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.optimization import (
    Differentiation,
    LeastSquares,
    LevenbergMarquardtResult,
    RobustLoss,
    attach_implicit_gradient,
    optimise_pose,
)
from foundpose.optimization.covariance import pose_covariance, residual_variance
from foundpose.optimization.implicit import check_differentiation
from foundpose.optimization.local_frame import LocalFrame
from foundpose.pnp.cost import reprojection_cost, reprojection_errors
from foundpose.pnp.problem import PnpProblem, usable_coordinates


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
        self.loss = LeastSquares() if loss is None else loss
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.differentiation: Differentiation = differentiation
        self.noise = noise

    def forward(self, T_camera_from_model: Tensor, problem: PnpProblem) -> PnpOptimum:
        """Optimise one pose per problem.

        Args:
            T_camera_from_model: (B, 4, 4) initial poses with every weighted point in front of the camera.
            problem: B problems. Points that are not valid or of weight zero are ignored.

        Returns:
            A :class:`PnpOptimum`.

        Differentiable w.r.t. the problem's points, ``K`` and weights, and the loss's parameters; in mode "unrolled"
        also w.r.t. the initial poses. ``T_camera_from_model`` and ``cost`` carry the gradient. Implicit gradients can
        be taken once (no second derivative). Where the points do not determine the pose they are zero. The weight of
        a point that is left out has none.
        """
        # Autocast would run the matrix products in half precision, too coarse for poses.
        with torch.autocast(problem.K.device.type, enabled=False):
            result, frame = self.optimise(T_camera_from_model, problem)
            variance = self._variance(result.T.detach(), problem.detach())
            variance = variance.masked_fill(result.failed, torch.inf)
            covariance = pose_covariance(result.H, variance, frame)
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
        problem: PnpProblem,
        tolerance: float | None = None,
        max_iterations: int | None = None,
        clean: bool = False,
    ) -> tuple[LevenbergMarquardtResult, LocalFrame]:
        """What :meth:`forward` does, without the covariance.

        Args:
            T_camera_from_model: see :meth:`forward`.
            problem: see :meth:`forward`.
            tolerance: takes the place of this module's own.
            max_iterations: lowers this module's own.
            clean: all numbers are known to be finite, and what is not valid has no weight: nothing is checked.

        Returns:
            A :class:`~foundpose.optimization.LevenbergMarquardtResult` with costs in px², and the frame that its
            ``H`` belongs to. A sample whose initial pose has a weighted point behind the camera, that has no weighted
            point, or any number in which is not finite, comes back as it was with ``failed`` set and without a
            gradient.
        """
        T = T_camera_from_model
        if not clean:
            T, problem, sane = _sanitise(T, problem)
        implicit = self.differentiation == "implicit"
        # The optimum does not depend on the frame that it is looked for in, nor on where the search begins.
        frame = _local_frame(T.detach(), problem.detach()) if implicit else _local_frame(T, problem)
        # Pixel coordinates carry rounding errors of a few units in their last place.
        rounding = 8.0 * torch.finfo(T.dtype).eps * problem.K.detach().abs().amax((-1, -2))
        result = optimise_pose(
            reprojection_cost(problem, frame, self.loss),
            frame.pose_to_local(T.detach() if implicit else T),
            differentiation=self.differentiation,
            max_iterations=min(self.max_iterations, max_iterations or self.max_iterations),
            tolerance=self.tolerance if tolerance is None else tolerance,
            floor=problem.weights.detach().sum(-1) * rounding.square(),
        )
        T = frame.pose_from_local(result.T)
        if not clean:
            T = torch.where(sane[:, None, None], T, T_camera_from_model)
        return result._replace(T=T), frame

    def attach_gradient(self, T_camera_from_model: Tensor, problem: PnpProblem) -> tuple[Tensor, Tensor]:
        """Give poses that this module has found (B, 4, 4) the gradient of the optimum.

        Returns:
            The poses, which do not change by a single bit, and which of them have a well-conditioned optimum (B,);
            the others have a gradient of zero.
        """
        T = T_camera_from_model.detach()
        frame = _local_frame(T, problem.detach())
        cost = reprojection_cost(problem, frame, self.loss)
        optimum = attach_implicit_gradient(cost, frame.pose_to_local(T))
        attached = frame.pose_from_local(optimum.T)
        return T + (attached - attached.detach()), optimum.regular

    def _variance(self, T: Tensor, problem: PnpProblem) -> Tensor:
        """Variance (B,) of an image coordinate of weight one, px²; infinite where it is not known."""
        if self.noise is not None:
            return torch.full_like(T[:, 0, 0], self.noise**2)
        squared, depth = reprojection_errors(T, problem)
        used = problem.valid & (problem.weights > 0) & (depth > 0)
        slope = torch.where(used, self.loss(squared)[1].detach(), 0.0)
        residual = torch.where(used, problem.weights * slope * squared, 0.0).sum(-1)
        # Two equations a point, of which a robust loss counts but a part, against six unknowns.
        return residual_variance(residual, 2.0 * slope.sum(-1) - 6.0)


def _sanitise(T: Tensor, problem: PnpProblem) -> tuple[Tensor, PnpProblem, Tensor]:
    """Poses and problems with stand-ins without weight, which fail, for what is not finite, and which are as they
    were (B,): no NaN may enter the graph, not even multiplied by zero."""
    weights = problem.weights.masked_fill(~problem.valid, 0.0)
    finite = usable_coordinates(problem.points_image) & usable_coordinates(problem.points_model)
    sane = torch.isfinite(T).all(-1).all(-1) & torch.isfinite(problem.K).all(-1).all(-1)
    sane = sane & (torch.isfinite(weights) & (finite | (weights == 0))).all(-1)
    identity = torch.eye(4, dtype=T.dtype, device=T.device)
    weights = weights.masked_fill(~(sane.unsqueeze(-1) & (weights > 0)), 0.0)
    left_out = (weights == 0).unsqueeze(-1)
    problem = PnpProblem(
        problem.points_image.masked_fill(left_out, 0.0),
        problem.points_model.masked_fill(left_out, 0.0),
        torch.where(sane[:, None, None], problem.K, identity[:3, :3]),
        problem.valid,
        weights,
    )
    return torch.where(sane[:, None, None], T, identity), problem, sane


def _local_frame(T: Tensor, problem: PnpProblem) -> LocalFrame:
    return LocalFrame.at(T, problem.points_model, problem.weights)

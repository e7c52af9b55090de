"""Alignment of template descriptors with a feature map."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.optimization import BarronLoss, Differentiation, Huber, RobustLoss, optimise_pose
from foundpose.optimization.covariance import pose_covariance, residual_variance
from foundpose.optimization.implicit import check_differentiation
from foundpose.optimization.local_frame import LocalFrame
from foundpose.refinement.cost import (
    AlignmentProblem,
    AutoScale,
    FeaturemetricCost,
    ResidualKind,
)
from foundpose.refinement.interpolation import Interpolation

# Numbers of the descriptors of the poses that are aligned at once.
_CPU_NUMBERS_PER_BLOCK = 1 << 20


class Alignment(NamedTuple):
    """Aligned poses.

    Attributes:
        T_crop_from_model: (n, 4, 4), mesh units; the initial pose, bit for bit, where the cost did not fall.
        cost: (n,) mean ρ over the template's patches.
        initial_cost: (n,) the same at the initial pose.
        relative_cost: (n,) cost as a share of what it would be if no patch were seen, in [0, 1] for a loss with a
            ceiling.
        iterations: (n,) int64.
        converged: (n,) bool.
        failed: (n,) bool, there is nothing to align (no patch in sight, or numbers that are not finite).
        covariance: (n, 6, 6) of the left twist (v, ω) in the crop's frame, in mesh units and radians, with the
            variance of a channel estimated from the residuals as if channels and patches were independent (they are
            not: it is too small, but tells directions apart). Infinite where undetermined. A constant for autograd.
    """

    T_crop_from_model: Tensor
    cost: Tensor
    initial_cost: Tensor
    relative_cost: Tensor
    iterations: Tensor
    converged: Tensor
    failed: Tensor
    covariance: Tensor


class FeaturemetricAlignment(nn.Module):
    """Moves poses so that template patches, projected into a crop, meet descriptors like their own.

    Minimises the mean of ``ρ(F(π(R x_i + t)) − p_i)`` over all patches i of a template by Levenberg-Marquardt, at
    most 30 iterations. A patch that leaves the crop or falls behind the camera counts the ceiling of ρ, so losing
    patches never looks like progress.

    Args:
        loss: robust loss ρ on squared residuals; None means ``BarronLoss(-5.0, 0.5)``, the paper's. Its scale c is in
            the unit of the descriptors and should be about the residual that a right match leaves in one channel
            (``residual="norm"``: in the norm): c = 0.5 suits DINOv2. For other descriptors take the median residual
            at right poses, or set ``auto_scale``.
        residual: "channel": ρ of each channel's residual, summed. "norm": ρ of the residual's length.
        normalize: compare descriptors of unit length.
        auto_scale: what c is a multiple of. False: c is the loss's own scale. "object": the loss's scale times the
            residual of right matches between the object's templates, which onboarding measures. True: c is,
            whatever the loss's own is, the residuals' robust standard deviation at the initial pose (1.4826 times
            their median magnitude), for each pose; slower, as that is larger than what right matches leave, and the
            cost flatter.
        interpolation: of the feature map; "bicubic" has continuous slopes.
        max_iterations: upper limit on the steps tried.
        tolerance: relative decrease of the cost that counts as converged.
        differentiation: gradient of the optimum ("implicit") or of the steps ("unrolled").

    Raises:
        ValueError: a setting out of range.

    Source: paper, "Featuremetric pose refinement".
    """

    def __init__(
        self,
        loss: RobustLoss | None = None,
        residual: ResidualKind = "channel",
        normalize: bool = False,
        auto_scale: AutoScale = False,
        interpolation: Interpolation = "bilinear",
        max_iterations: int = 30,
        tolerance: float = 1e-4,
        differentiation: Differentiation = "implicit",
    ) -> None:
        super().__init__()
        loss = BarronLoss(-5.0, 0.5) if loss is None else loss
        if residual not in ("channel", "norm"):
            raise ValueError(f"residual must be 'channel' or 'norm', got {residual!r}")
        if interpolation not in ("bilinear", "bicubic"):
            raise ValueError(f"interpolation must be 'bilinear' or 'bicubic', got {interpolation!r}")
        if max_iterations < 1 or not tolerance >= 0:
            raise ValueError(
                f"max_iterations must be at least 1 and tolerance not negative, got {max_iterations} and {tolerance}"
            )
        if auto_scale == "object" and normalize and residual == "channel":
            raise ValueError(
                "auto_scale='object' knows no size of single channels of normalised descriptors: use "
                "residual='norm', or "
                "normalize=False"
            )
        if auto_scale not in (False, True, "object"):
            raise ValueError(f"auto_scale must be true, false or 'object', got {auto_scale!r}")
        if auto_scale and not isinstance(loss, BarronLoss | Huber):
            raise ValueError(f"auto_scale needs a loss with a scale, got {type(loss).__name__}")
        check_differentiation(differentiation)
        self.loss = loss
        self.residual: ResidualKind = residual
        self.normalize = normalize
        self.auto_scale: AutoScale = auto_scale
        self.interpolation: Interpolation = interpolation
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.differentiation: Differentiation = differentiation

    def forward(self, T_crop_from_model: Tensor, problem: AlignmentProblem) -> Alignment:
        """Align n poses.

        Args:
            T_crop_from_model: (n, 4, 4) initial poses.
            problem: what they are aligned with.

        Returns:
            An :class:`Alignment`.

        Differentiable w.r.t. the feature maps, descriptors, 3D points, ``K`` and the loss's parameters, in mode
        "unrolled" also w.r.t. the initial poses; ``T_crop_from_model`` and the costs carry the gradient. Which cells
        are read, and which patches are lost, is constant, and so is an automatic scale.
        """
        poses = len(T_crop_from_model)
        if T_crop_from_model.device.type == "cpu" and poses > 1:
            # Poses are independent, and so many as a core's cache holds take less time each than all together.
            most = max(1, _CPU_NUMBERS_PER_BLOCK // max(1, problem.descriptors[0].numel()))
            if poses > most:
                blocks = [slice(first, first + most) for first in range(0, poses, most)]
                parts = [self._align(T_crop_from_model[rows], problem.take(rows)) for rows in blocks]
                return Alignment(*(torch.cat(field) for field in zip(*parts, strict=True)))
        return self._align(T_crop_from_model, problem)

    def _align(self, T: Tensor, problem: AlignmentProblem) -> Alignment:
        """Align all poses at once."""
        sane = torch.isfinite(T.detach()).all(-1).all(-1)
        start = torch.where(sane[:, None, None], T, torch.eye(4, dtype=T.dtype, device=T.device))
        valid = problem.valid & sane.unsqueeze(-1)
        problem = problem._replace(
            valid=valid,
            descriptors=problem.descriptors.masked_fill(~valid.unsqueeze(-1), 0.0),
            points_model=problem.points_model.masked_fill(~valid.unsqueeze(-1), 0.0),
        )
        if self.normalize:
            problem = problem._replace(
                maps=problem.maps._replace(values=nn.functional.normalize(problem.maps.values, dim=-1)),
                descriptors=nn.functional.normalize(problem.descriptors, dim=-1),
            )
        points = problem.points_model
        if self.differentiation == "implicit":
            # The minimum depends neither on the start nor on the frame.
            start, points = start.detach(), points.detach()
        frame = LocalFrame.at(start, points, valid.to(T.dtype))
        start_local = frame.pose_to_local(start)
        cost = FeaturemetricCost(
            problem, frame, start_local, self.loss, self.residual, self.auto_scale, self.interpolation
        )
        result = optimise_pose(
            lambda T_local: cost(T_local).equations,
            start_local,
            differentiation=self.differentiation,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
        )
        with torch.no_grad():
            seen = cost(result.T)
            energy, weights = seen.totals()
        improved = ~result.failed & (result.cost < result.initial_cost)
        T_aligned = frame.pose_from_local(result.T)
        # A start that is the optimum already keeps its value to the bit, but has the optimum's gradient.
        T_kept = torch.where(result.failed[:, None, None], T, T.detach() + (T_aligned - T_aligned.detach()))
        T_final = torch.where(improved[:, None, None], T_aligned, T_kept)
        # The equations have the half of the mean of ρ.
        least = 2.0 * result.cost
        variance = residual_variance(energy, weights * cost.count - 6.0)
        return Alignment(
            T_crop_from_model=T_final,
            cost=least,
            initial_cost=2.0 * result.initial_cost,
            relative_cost=least / cost.mean_ceiling().clamp(min=torch.finfo(T.dtype).tiny),
            iterations=result.iterations,
            converged=result.converged,
            failed=result.failed,
            covariance=pose_covariance(seen.equations.H, variance, frame),
        )

    def residual_size(self) -> str:
        """Which of an object's scales is the size of a residual (see ``DescriptorScales``)."""
        if self.residual == "norm":
            return "unit" if self.normalize else "match"
        return "channel"

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return (
            f"residual={self.residual!r}, normalize={self.normalize}, auto_scale={self.auto_scale}, "
            f"interpolation={self.interpolation!r}, max_iterations={self.max_iterations}, "
            f"tolerance={self.tolerance}, differentiation={self.differentiation!r}"
        )

"""Alignment of template descriptors with a feature map: the cost, its normal equations and its minimum."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry import PatchGrid
from foundpose.optimization import (
    BarronLoss,
    Differentiation,
    Huber,
    NormalEquations,
    RobustLoss,
    optimise_pose,
)
from foundpose.optimization.cholesky import scaled_cholesky
from foundpose.optimization.implicit import check_differentiation
from foundpose.pnp.polish import LocalFrame, project_in_frame
from foundpose.refinement.interpolation import Interpolation, sample_features

ResidualKind = Literal["channel", "norm"]
AutoScale = bool | Literal["object"]

_OF_EACH_POSE = ("map_index", "K", "descriptors", "points_model", "valid")
# Numbers of the descriptors of the poses that are aligned at once.
_CPU_NUMBERS_PER_BLOCK = 1 << 20


class AlignmentProblem(NamedTuple):
    """What n poses are aligned with.

    Attributes:
        features: (m, h, w, d) projected feature maps of crops, channels last.
        map_index: (n,) which map belongs to each pose, int64.
        grid: where the map's cells lie in the crop.
        image_size: side of the crops in pixels.
        K: (n, 3, 3) intrinsics of the crops.
        descriptors: (n, P, d) of the template's patches.
        points_model: (n, P, 3) mesh units.
        valid: (n, P) bool.
        sizes: (n,) size of the residual that right matches of each pose's object leave, in the alignment's kind of
            residual; for ``auto_scale="object"``.
    """

    features: Tensor
    map_index: Tensor
    grid: PatchGrid
    image_size: int
    K: Tensor
    descriptors: Tensor
    points_model: Tensor
    valid: Tensor
    sizes: Tensor | None = None

    def take(self, rows: slice) -> "AlignmentProblem":
        """The part of some of the poses."""
        mine = {name: getattr(self, name)[rows] for name in _OF_EACH_POSE}
        return self._replace(**mine, sizes=None if self.sizes is None else self.sizes[rows])


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
                features=nn.functional.normalize(problem.features, dim=-1),
                descriptors=nn.functional.normalize(problem.descriptors, dim=-1),
            )
        if self.differentiation == "implicit":
            # The minimum depends neither on the start nor on the frame.
            start = start.detach()
            frame = LocalFrame.at(start, problem.points_model.detach(), valid.to(T.dtype))
        else:
            frame = LocalFrame.at(start, problem.points_model, valid.to(T.dtype))
        goal = _Goal.of(problem, frame)
        start_local = frame.pose_to_local(start)
        unit = self._unit(start_local, goal)
        descriptors = problem.descriptors.detach()
        ceiling = self._ceiling(descriptors if unit is None else descriptors * unit[:, None, None])

        def evaluate(T_local: Tensor) -> NormalEquations:
            return self._equations(T_local, goal, unit, ceiling)[0]

        result = optimise_pose(
            evaluate,
            start_local,
            differentiation=self.differentiation,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
        )
        with torch.no_grad():
            seen = self._equations(result.T, goal, unit, ceiling)
        improved = ~result.failed & (result.cost < result.initial_cost)
        T_aligned = frame.pose_from_local(result.T)
        # A start that is the optimum already keeps its value to the bit, but has the optimum's gradient.
        T_kept = torch.where(result.failed[:, None, None], T, T.detach() + (T_aligned - T_aligned.detach()))
        T_final = torch.where(improved[:, None, None], T_aligned, T_kept)
        count = valid.sum(-1).clamp(min=1)
        most = ceiling.masked_fill(~valid, 0.0).sum(-1) / count
        # The equations have the half of the mean of ρ.
        cost, initial = 2.0 * result.cost, 2.0 * result.initial_cost
        return Alignment(
            T_crop_from_model=T_final,
            cost=cost,
            initial_cost=initial,
            relative_cost=cost / most.clamp(min=torch.finfo(T.dtype).tiny),
            iterations=result.iterations,
            converged=result.converged,
            failed=result.failed,
            covariance=_covariance(result.H.detach(), seen[1], seen[2], count, frame),
        )

    def residual_size(self) -> str:
        """Which of an object's scales is the size of a residual (see ``DescriptorScales``)."""
        if self.residual == "norm":
            return "unit" if self.normalize else "match"
        return "channel"

    def _loss_scale(self) -> Tensor | float:
        """c of the loss."""
        assert isinstance(self.loss, BarronLoss | Huber)
        return self.loss.scale

    def _unit(self, T_local: Tensor, goal: "_Goal") -> Tensor | None:
        """Factors (n,) that bring residuals to the loss's unit; None without an automatic scale."""
        if not self.auto_scale:
            return None
        if self.auto_scale == "object":
            if goal.problem.sizes is None:
                raise ValueError("auto_scale is 'object': give the problem's sizes, or set it to false")
            return goal.problem.sizes.to(T_local.dtype).reciprocal()
        with torch.no_grad():
            rows, seen, _ = _residual_rows(T_local, goal, self.interpolation)
            size = rows[:, :, 0].abs()
            if self.residual == "norm":
                size = torch.linalg.vector_norm(size, dim=-1, keepdim=True)
            size = size.masked_fill(~seen.unsqueeze(-1), torch.nan).flatten(1)
            spread = 1.4826 * size.nanmedian(dim=1).values
            scale = torch.as_tensor(self._loss_scale(), dtype=spread.dtype, device=spread.device)
            return torch.where(spread > 0, scale / spread, torch.ones_like(spread))

    def _ceiling(self, descriptors: Tensor) -> Tensor:
        """Cost (n, P) of a patch that is not seen."""
        known = self.loss.fixed_alpha if isinstance(self.loss, BarronLoss) else 0.0
        bound: Tensor | None = None
        if isinstance(self.loss, BarronLoss) and (known is None or known < 0):
            channels = descriptors.shape[-1] if self.residual == "channel" else 1
            bound = (channels * self.loss.ceiling.to(descriptors.dtype)).expand(descriptors.shape[:2])
            if known is not None:
                return bound
        # A loss without a ceiling: as if the crop showed the opposite of what the patch looks like.
        squared = (2.0 * descriptors).square()
        if self.residual == "norm":
            squared = squared.sum(-1, keepdim=True)
        opposite = self.loss(squared)[0].sum(-1)
        # α is learned: which of the two it is, the device knows.
        return opposite if bound is None else torch.where(torch.isfinite(bound), bound, opposite)

    def _equations(
        self, T_local: Tensor, goal: "_Goal", unit: Tensor | None, ceiling: Tensor
    ) -> tuple[NormalEquations, Tensor, Tensor]:
        """Normal equations of ½ mean ρ; weighted sum of squared residuals (n,) and sum of weights (n,)."""
        rows, seen, J = _residual_rows(T_local, goal, self.interpolation)
        if unit is not None:
            rows = rows * unit[:, None, None, None]
        squared = rows[:, :, 0].square()
        if self.residual == "norm":
            squared = squared.sum(-1, keepdim=True)
        rho, weight = self.loss(squared)
        valid = goal.problem.valid
        count = valid.sum(-1).clamp(min=1).to(rho.dtype)
        lost = valid & ~seen
        cost = torch.where(seen, rho.sum(-1), torch.where(lost, ceiling, torch.zeros_like(ceiling)))
        weight = weight * (seen / count.unsqueeze(-1)).unsqueeze(-1)
        # All channels of a patch come down to the products of its three rows.
        products = (rows * weight.unsqueeze(2)).flatten(0, 1) @ rows.flatten(0, 1).transpose(1, 2)
        products = products.unflatten(0, valid.shape).permute(0, 2, 3, 1)  # (n, 3, 3, P)
        gram, pull = products[:, 1:, 1:], products[:, 1:, 0]
        weighted = (J * gram[:, None, 0]).sum(2), (J * gram[:, None, 1]).sum(2)
        H = torch.stack(weighted, dim=2).flatten(2) @ J.flatten(2).transpose(1, 2)
        g = (J.flatten(2) @ pull.flatten(1).unsqueeze(-1)).squeeze(-1)
        energy = products[:, 0, 0].sum(-1).detach()
        return NormalEquations(0.5 * cost.sum(-1) / count, H, g), energy, weight.sum((-1, -2)).detach()

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return (
            f"residual={self.residual!r}, normalize={self.normalize}, auto_scale={self.auto_scale}, "
            f"interpolation={self.interpolation!r}, max_iterations={self.max_iterations}, "
            f"tolerance={self.tolerance}, differentiation={self.differentiation!r}"
        )


class _Goal(NamedTuple):
    """What poses are aligned with, in the frame that they are optimised in.

    Attributes:
        problem: as given.
        frame: the local frames.
        points_local: (n, P, 3).
        minus_descriptors: (n, P, 3, d): minus the descriptors, and two rows of zeros.
    """

    problem: AlignmentProblem
    frame: LocalFrame
    points_local: Tensor
    minus_descriptors: Tensor

    @classmethod
    def of(cls, problem: AlignmentProblem, frame: LocalFrame) -> "_Goal":
        """A problem in a frame."""
        rows = nn.functional.pad(-problem.descriptors.unsqueeze(2), (0, 0, 0, 2))
        return cls(problem, frame, frame.points(problem.points_model), rows)


def _residual_rows(
    T_local: Tensor, goal: _Goal, interpolation: Interpolation
) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals of patches and their slopes along columns and rows of the map (n, P, 3, d), which patches are seen
    (n, P), and derivatives of the map's coordinates in the pose (n, 6, 2, P)."""
    problem = goal.problem
    pixels, depth, J = project_in_frame(T_local, goal.points_local, problem.K, goal.frame)
    inside = ((pixels >= -0.5) & (pixels <= problem.image_size - 0.5)).all(1)
    seen = problem.valid & (depth > 0) & inside
    pixels = torch.where(seen.unsqueeze(1), pixels, torch.zeros_like(pixels))
    position = problem.grid.to_map(pixels).transpose(1, 2)
    rows = sample_features(
        problem.features, problem.map_index, position, interpolation, goal.minus_descriptors
    )
    J = torch.where(seen[:, None, None], J, torch.zeros_like(J)) / problem.grid.stride
    return rows, seen, J


def _covariance(H: Tensor, energy: Tensor, weights: Tensor, count: Tensor, frame: LocalFrame) -> Tensor:
    """Covariance (n, 6, 6) in the crop's frame from the equations of the mean."""
    system = scaled_cholesky(H, H.diagonal(dim1=-2, dim2=-1))
    freedom = weights * count - 6.0
    variance = energy / freedom.clamp(min=torch.finfo(H.dtype).eps)
    to_crop = frame.twist_to_camera()
    covariance = variance[:, None, None] * (to_crop @ system.inverse() @ to_crop.transpose(-1, -2))
    unknown = torch.diag_embed(torch.full_like(H[:, 0], torch.inf))
    return torch.where((system.usable & (freedom > 0.5))[:, None, None], covariance, unknown)

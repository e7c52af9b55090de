"""The cost of featuremetric alignment, and its normal equations."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from foundpose.geometry import PatchGrid
from foundpose.optimization import BarronLoss, Huber, NormalEquations, RobustLoss
from foundpose.optimization.local_frame import LocalFrame, LocalProjection
from foundpose.refinement.interpolation import FeatureSampler, Interpolation

ResidualKind = Literal["channel", "norm"]
AutoScale = bool | Literal["object"]


class FeatureMaps(NamedTuple):
    """Feature maps of crops.

    Attributes:
        values: (m, h, w, d) projected descriptors, channels last.
        grid: where the maps' cells lie in the crops.
        image_size: side of the crops in pixels.
    """

    values: Tensor
    grid: PatchGrid
    image_size: int


class AlignmentProblem(NamedTuple):
    """What n poses are aligned with.

    Attributes:
        maps: feature maps of crops.
        map_index: (n,) which map belongs to each pose, int64.
        K: (n, 3, 3) intrinsics of the crops.
        descriptors: (n, P, d) of the template's patches.
        points_model: (n, P, 3) mesh units.
        valid: (n, P) bool.
        sizes: (n,) size of the residual that right matches of each pose's object leave, in the alignment's kind of
            residual; for ``auto_scale="object"``.
    """

    maps: FeatureMaps
    map_index: Tensor
    K: Tensor
    descriptors: Tensor
    points_model: Tensor
    valid: Tensor
    sizes: Tensor | None = None

    def take(self, rows: slice) -> "AlignmentProblem":
        """The part of some of the poses."""
        sizes = None if self.sizes is None else self.sizes[rows]
        map_index, K, descriptors, points_model, valid = (x[rows] for x in self[1:6])
        return AlignmentProblem(self.maps, map_index, K, descriptors, points_model, valid, sizes)


class Linearisation(NamedTuple):
    """The cost of n poses near where they are.

    Attributes:
        equations: normal equations of ½ mean ρ.
        squared: (n, P, d or 1) squared residuals.
        weights: (n, P, d or 1) their weights in the equations, but for the share of their patch.
        share: (n, P) one by the number of patches, zero for a patch that is not seen.
    """

    equations: NormalEquations
    squared: Tensor
    weights: Tensor
    share: Tensor

    def totals(self) -> tuple[Tensor, Tensor]:
        """Weighted sum of the squared residuals (n,), and sum of the weights (n,); constants for autograd."""
        weights = (self.weights * self.share.unsqueeze(-1)).detach()
        return (weights * self.squared.detach()).sum((-1, -2)), weights.sum((-1, -2))


class FeaturemetricCost:
    """½ mean over the patches of ``ρ(F(π(R x_i + t)) − p_i)``, of n poses in their local frames.

    Args:
        problem: what the poses are aligned with.
        frame: the local frames.
        T_local: (n, 4, 4) initial poses, where an automatic scale is measured.
        loss: ρ on squared residuals.
        residual: "channel" or "norm".
        auto_scale: see :class:`~foundpose.refinement.FeaturemetricAlignment`.
        interpolation: of the feature maps.

    Raises:
        ValueError: the problem lacks the sizes that ``auto_scale="object"`` needs.
    """

    def __init__(
        self,
        problem: AlignmentProblem,
        frame: LocalFrame,
        T_local: Tensor,
        loss: RobustLoss,
        residual: ResidualKind = "channel",
        auto_scale: AutoScale = False,
        interpolation: Interpolation = "bilinear",
    ) -> None:
        self.problem = problem
        self.frame = frame
        self.loss = loss
        self.residual = residual
        maps = problem.maps
        self.project = LocalProjection(frame, problem.points_model, maps.grid.map_intrinsics(problem.K))
        self.sample = FeatureSampler(maps.values, problem.map_index, interpolation)
        # Where the crop begins and ends in the map's coordinates.
        self._edges = maps.grid.to_map(-0.5), maps.grid.to_map(maps.image_size - 0.5)
        self.count = problem.valid.sum(-1).clamp(min=1)
        self._unit = self._measured_unit(T_local, auto_scale) if auto_scale else None
        descriptors = problem.descriptors.detach()
        self.ceiling = self._ceiling(
            descriptors if self._unit is None else descriptors * self._unit[:, None, None]
        )
        # What a patch costs while it is not seen.
        self._lost = self.ceiling.masked_fill(~problem.valid, 0.0)
        self._per_patch = self.count.to(self._lost.dtype).reciprocal().unsqueeze(-1)

    def __call__(self, T_local: Tensor) -> Linearisation:
        """Linearise the cost at poses (n, 4, 4) for ``T_local ← exp(δ) @ T_local``; differentiable."""
        rows, seen, J = self._residual_rows(T_local)
        if self._unit is not None:
            rows = rows * self._unit[:, None, None]
        squared = rows[0].square()
        if self.residual == "norm":
            squared = squared.sum(-1, keepdim=True)
        rho, weight = self.loss(squared)
        share = seen * self._per_patch
        cost = (torch.where(seen, rho.sum(-1), self._lost) * self._per_patch).sum(-1)
        # All channels of a patch come down to the products of its slopes with its three rows.
        slopes, rows = (rows[1:] * weight).flatten(1, 2), rows.flatten(1, 2)
        products = torch.bmm(slopes.transpose(0, 1), rows.permute(1, 2, 0)).unflatten(0, seen.shape)
        products = products.permute(0, 2, 3, 1) * share[:, None, None]  # (n, 2, 3, P)
        weighted = (J.unsqueeze(3) * products.unsqueeze(1)).sum(2)  # (n, 6, 3, P)
        H = torch.bmm(weighted[:, :, 1:].flatten(2), J.flatten(2).transpose(1, 2))
        g = weighted[:, :, 0].sum(-1)
        return Linearisation(NormalEquations(0.5 * cost, H, g), squared, weight, share)

    def mean_ceiling(self) -> Tensor:
        """Mean ρ (n,) if no patch were seen."""
        return (self._lost * self._per_patch).sum(-1)

    def _residual_rows(self, T_local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals of patches and their slopes along columns and rows of the map (3, n, P, d), which patches are
        seen (n, P), and derivatives of the map's coordinates in the pose (n, 6, 2, P)."""
        position, depth, J = self.project(T_local)
        first, last = self._edges
        seen = self.problem.valid & (depth > 0) & (position.clamp(first, last) == position).all(1)
        rows = self.sample(position.transpose(1, 2).contiguous())
        rows[0].sub_(self.problem.descriptors)
        return rows, seen, J

    @torch.no_grad()
    def _measured_unit(self, T_local: Tensor, auto_scale: AutoScale) -> Tensor:
        """Factors (n,) that bring residuals to the loss's unit."""
        if auto_scale == "object":
            if self.problem.sizes is None:
                raise ValueError("auto_scale is 'object': give the problem's sizes, or set it to false")
            return self.problem.sizes.to(T_local.dtype).reciprocal()
        assert isinstance(self.loss, BarronLoss | Huber)
        rows, seen, _ = self._residual_rows(T_local)
        size = rows[0].abs()
        if self.residual == "norm":
            size = torch.linalg.vector_norm(size, dim=-1, keepdim=True)
        size = size.masked_fill(~seen.unsqueeze(-1), torch.nan).flatten(1)
        spread = 1.4826 * size.nanmedian(dim=1).values
        scale = torch.as_tensor(self.loss.scale, dtype=spread.dtype, device=spread.device)
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

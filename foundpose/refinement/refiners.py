"""Refiners: featuremetric, and several in a row."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from foundpose.geometry import grow_masks, project_points, transform_points
from foundpose.refinement.base import Observation, PoseProposals, PoseRefiner
from foundpose.refinement.cost import AlignmentProblem, FeatureMaps
from foundpose.refinement.featuremetric import FeaturemetricAlignment
from foundpose.representation import ObjectGroups, ObjectRepresentation, TemplatePatches


class FeaturemetricRefiner(PoseRefiner):
    """Aligns the patches of each proposal's template with the crop's feature map.

    The score is one minus the relative cost: 1 where all patches meet their like, 0 where none is seen.

    Args:
        alignment: the optimisation; None means the paper's settings.
        num_views: align the patches of so many templates, those that see the object most as the initial pose does.
            None: those of the proposal's own template (the paper).
        mask_margin: leave out patches that the initial pose puts outside the crop's mask, by more than so many pixels
            of the crop: what is hidden, or cut off, would only pull the pose to where something of the object is
            seen.
            None: all patches count (the paper).

    Raises:
        ValueError: a setting out of range.

    Source: paper, "Featuremetric pose refinement".
    """

    def __init__(
        self,
        alignment: FeaturemetricAlignment | None = None,
        num_views: int | None = None,
        mask_margin: float | None = None,
    ) -> None:
        super().__init__()
        if num_views is not None and num_views < 1:
            raise ValueError(f"num_views must be at least 1 or None, got {num_views}")
        if mask_margin is not None and not mask_margin >= 0:
            raise ValueError(f"mask_margin must not be negative (pixels), or None; got {mask_margin}")
        self.alignment = FeaturemetricAlignment() if alignment is None else alignment
        self.num_views = num_views
        self.mask_margin = mask_margin

    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        """Refine all proposals as one batch.

        Returns:
            Poses, scores and which are valid: those that came valid and could be aligned.

        Differentiable as :class:`FeaturemetricAlignment`: w.r.t. the crops' descriptors, the objects' buffers, the
        crops' intrinsics and (unrolled) the proposed poses.
        """
        B, n = proposals.valid.shape
        T = proposals.T_crop_from_model.flatten(0, 1)
        problem = alignment_problem(proposals, observation, self.num_views)
        if self.alignment.auto_scale == "object":
            problem = problem._replace(sizes=self._sizes(observation.groups).to(T).repeat_interleave(n))
        if self.mask_margin is not None:
            masks = observation.crops.masks
            problem = problem._replace(
                valid=problem.valid & patches_on_mask(T, problem, masks, self.mask_margin)
            )
        result = self.alignment(T, problem)
        moved = proposals.valid.flatten() & ~result.failed
        score = torch.where(moved, 1.0 - result.relative_cost, torch.zeros_like(result.cost))
        return proposals._replace(
            T_crop_from_model=torch.where(moved[:, None, None], result.T_crop_from_model, T).unflatten(
                0, (B, n)
            ),
            score=score.unflatten(0, (B, n)),
            valid=moved.unflatten(0, (B, n)),
        )

    def _sizes(self, groups: ObjectGroups) -> Tensor:
        """Residual of right matches of each crop's object (B,)."""
        name = self.alignment.residual_size()
        sizes = [obj.info.scale(name, "residual_scale") for obj in groups.objects]
        return torch.tensor(sizes)[groups.object_index]


def patches_on_mask(T: Tensor, problem: AlignmentProblem, masks: Tensor, margin: float) -> Tensor:
    """Which patches (n, P) poses (n, 4, 4) put on the crops' masks (B, S, S), or less than ``margin`` pixels away."""
    size = masks.shape[-1]
    with torch.no_grad():
        pixels, depth = project_points(transform_points(T, problem.points_model), problem.K)
        column, row = pixels.nan_to_num(nan=-1.0).clamp(-1.0, size).round().long().unbind(-1)
        in_crop = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        near = grow_masks(masks > 0.5, int(margin))
        found = near[problem.map_index.unsqueeze(-1), row.clamp(0, size - 1), column.clamp(0, size - 1)]
        return found & in_crop & (depth > 0)


def alignment_problem(
    proposals: PoseProposals, observation: Observation, num_views: int | None = None
) -> AlignmentProblem:
    """Feature maps and template patches of all proposals, padded to the most of any.

    Args:
        proposals: the poses.
        observation: the crops, and their objects.
        num_views: see :class:`FeaturemetricRefiner`.
    """
    B, n = proposals.valid.shape
    T = proposals.T_crop_from_model
    raw = observation.features.patches.permute(0, 2, 3, 1)

    def project(obj: ObjectRepresentation, rows: Tensor) -> Tensor:
        return obj.projection(raw[rows].to(obj.projection.components.dtype)).to(T.dtype)

    def patches_of(obj: ObjectRepresentation, rows: Tensor) -> TemplatePatches:
        if num_views is None:
            views = proposals.template_index[rows].unsqueeze(-1)
        else:
            views = obj.nearest_views(T[rows].detach(), num_views)
        return TemplatePatches(*(x.flatten(2, 3) for x in obj.gather_templates(views)))

    patches = TemplatePatches(*(x.flatten(0, 1) for x in observation.groups.map(patches_of)))
    return AlignmentProblem(
        maps=FeatureMaps(
            observation.groups.map(project), observation.grid, observation.crops.images.shape[-1]
        ),
        map_index=torch.arange(B, device=T.device).repeat_interleave(n),
        K=observation.crops.K_crop.to(T.dtype).repeat_interleave(n, dim=0),
        descriptors=patches.descriptors.to(T.dtype),
        points_model=patches.points_model.to(T.dtype),
        valid=patches.valid & proposals.valid.flatten().unsqueeze(-1),
    )


class RefinerChain(PoseRefiner):
    """Several refiners, each of which starts from the poses of the one before.

    Args:
        refiners: in the order in which they are run; the last one gives the scores.

    Raises:
        ValueError: no refiner.
    """

    def __init__(self, refiners: Sequence[PoseRefiner]) -> None:
        super().__init__()
        if len(refiners) == 0:
            raise ValueError("refiners is empty: give at least one, or no chain")
        self.refiners = nn.ModuleList(refiners)

    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        """Refine. Differentiable as the refiners are."""
        for refiner in self.refiners:
            proposals = refiner(proposals, observation)
        return proposals

"""Refiners: featuremetric, and several in a row."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.geometry import project_points, transform_points
from foundpose.refinement.base import PoseProposals, PoseRefiner, RefinedPoses
from foundpose.refinement.featuremetric import AlignmentProblem, FeaturemetricAlignment
from foundpose.utils.devices import indices_on


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

    def forward(self, proposals: PoseProposals) -> RefinedPoses:
        """Refine all proposals as one batch.

        Returns:
            Poses, scores and which are valid: those that came valid and could be aligned.

        Differentiable as :class:`FeaturemetricAlignment`: w.r.t. the crops' descriptors, the objects' buffers, the
        crops' intrinsics and (unrolled) the proposed poses.
        """
        B, n = proposals.valid.shape
        T = proposals.T_crop_from_model.flatten(0, 1)
        problem = alignment_problem(proposals, self.num_views)
        if self.alignment.auto_scale == "object":
            problem = problem._replace(sizes=self._sizes(proposals).to(T).repeat_interleave(n))
        if self.mask_margin is not None:
            problem = problem._replace(
                valid=problem.valid & _on_mask(T, problem, proposals, self.mask_margin)
            )
        result = self.alignment(T, problem)
        moved = proposals.valid.flatten() & ~result.failed
        return RefinedPoses(
            torch.where(moved[:, None, None], result.T_crop_from_model, T).unflatten(0, (B, n)),
            torch.where(moved, 1.0 - result.relative_cost, torch.zeros_like(result.cost)).unflatten(
                0, (B, n)
            ),
            moved.unflatten(0, (B, n)),
        )

    def _sizes(self, proposals: PoseProposals) -> Tensor:
        """Residual of right matches of each crop's object (B,)."""
        name = self.alignment.residual_size()
        sizes = [obj.info.scale(name, "residual_scale") for obj in proposals.objects]
        return torch.tensor(sizes)[proposals.object_index]


def _on_mask(T: Tensor, problem: AlignmentProblem, proposals: PoseProposals, margin: float) -> Tensor:
    """Which patches (n, P) poses (n, 4, 4) put on the crop's mask, or less than ``margin`` pixels from it."""
    with torch.no_grad():
        points = transform_points(T, problem.points_model)
        pixels, depth = project_points(points, problem.K)
        inside = (proposals.crops.masks > 0.5).to(pixels.dtype)[:, None]
        if margin >= 1:
            # A square in two steps.
            r = int(margin)
            inside = F.max_pool2d(inside, (2 * r + 1, 1), stride=1, padding=(r, 0))
            inside = F.max_pool2d(inside, (1, 2 * r + 1), stride=1, padding=(0, r))
        grid = ((2.0 * pixels + 1.0) / problem.image_size - 1.0).nan_to_num(nan=-2.0).clamp(-2.0, 2.0)
        per_crop = grid.unflatten(0, proposals.valid.shape)
        share = F.grid_sample(inside, per_crop.flatten(1, 2)[:, None], mode="nearest", align_corners=False)
        return (share.reshape(depth.shape) > 0.5) & (depth > 0)


def alignment_problem(proposals: PoseProposals, num_views: int | None = None) -> AlignmentProblem:
    """Feature maps and template patches of all proposals, padded to the most of any.

    Args:
        proposals: the poses.
        num_views: see :class:`FeaturemetricRefiner`.
    """
    B, n = proposals.valid.shape
    raw = proposals.features.patches.permute(0, 2, 3, 1)
    device = raw.device
    dtype = proposals.T_crop_from_model.dtype
    maps: list[Tensor] = []
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    order: list[Tensor] = []
    for i, representation in enumerate(proposals.objects):
        rows = torch.nonzero(proposals.object_index == i).flatten()
        if len(rows) == 0:
            continue
        rows_here = indices_on(device, rows)
        projection = representation.projection
        maps.append(projection(raw[rows_here].to(projection.components.dtype)).to(dtype))
        if num_views is None:
            views = proposals.template_index[rows_here].flatten().unsqueeze(1)
        else:
            T = proposals.T_crop_from_model[rows_here].flatten(0, 1).detach()
            views = representation.nearest_views(T, num_views)
        patches = representation.gather_templates(views)
        descriptors, points = patches.descriptors.flatten(1, 2), patches.points_model.flatten(1, 2)
        parts.append((descriptors.to(dtype), points.to(dtype), patches.valid.flatten(1)))
        order.append(rows)
    most = max(valid.shape[1] for _, _, valid in parts)
    padded = [
        (
            F.pad(descriptors, (0, 0, 0, most - valid.shape[1])),
            F.pad(points, (0, 0, 0, most - valid.shape[1])),
            F.pad(valid, (0, most - valid.shape[1])),
        )
        for descriptors, points, valid in parts
    ]
    # Back to the order of the batch.
    back = indices_on(device, torch.cat(order).argsort())
    poses = (back[:, None] * n + torch.arange(n, device=device)).flatten()
    descriptors, points, valid = (torch.cat(field)[poses] for field in zip(*padded, strict=True))
    return AlignmentProblem(
        features=torch.cat(maps)[back],
        map_index=torch.arange(B, device=device).repeat_interleave(n),
        grid=proposals.grid,
        image_size=proposals.crops.images.shape[-1],
        K=proposals.crops.K_crop.to(dtype).repeat_interleave(n, dim=0),
        descriptors=descriptors,
        points_model=points,
        valid=valid & proposals.valid.flatten().unsqueeze(-1),
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

    def forward(self, proposals: PoseProposals) -> RefinedPoses:
        """Refine. Differentiable as the refiners are."""
        poses = RefinedPoses(proposals.T_crop_from_model, proposals.score, proposals.valid)
        for refiner in self.refiners:
            poses = refiner(proposals._replace(**poses._asdict()))
        return poses

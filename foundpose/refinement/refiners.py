"""Refiners: featuremetric, and several in a row."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.devices import indices_on
from foundpose.refinement.base import PoseProposals, PoseRefiner, RefinedPoses
from foundpose.refinement.featuremetric import AlignmentProblem, FeaturemetricAlignment


class FeaturemetricRefiner(PoseRefiner):
    """Aligns the patches of each proposal's template with the crop's feature map.

    The score is one minus the relative cost: 1 where all patches meet their like, 0 where none is seen.

    Args:
        alignment: the optimisation; None means the paper's settings.

    Source: paper, "Featuremetric pose refinement".
    """

    def __init__(self, alignment: FeaturemetricAlignment | None = None) -> None:
        super().__init__()
        self.alignment = FeaturemetricAlignment() if alignment is None else alignment

    def forward(self, proposals: PoseProposals) -> RefinedPoses:
        """Refine all proposals as one batch.

        Returns:
            Poses, scores and which are valid: those that came valid and could be aligned.

        Differentiable as :class:`FeaturemetricAlignment`: w.r.t. the crops' descriptors, the objects' buffers, the
        crops' intrinsics and (unrolled) the proposed poses.
        """
        B, n = proposals.valid.shape
        T = proposals.T_crop_from_model.flatten(0, 1)
        result = self.alignment(T, alignment_problem(proposals))
        moved = proposals.valid.flatten() & ~result.failed
        return RefinedPoses(
            torch.where(moved[:, None, None], result.T_crop_from_model, T).unflatten(0, (B, n)),
            torch.where(moved, 1.0 - result.relative_cost, torch.zeros_like(result.cost)).unflatten(
                0, (B, n)
            ),
            moved.unflatten(0, (B, n)),
        )


def alignment_problem(proposals: PoseProposals) -> AlignmentProblem:
    """Feature maps and template patches of all proposals, padded to the largest template."""
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
        patches = representation.gather_templates(proposals.template_index[rows_here].flatten())
        parts.append((patches.descriptors.to(dtype), patches.points_model.to(dtype), patches.valid))
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
        stride=proposals.stride,
        offset=proposals.offset,
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

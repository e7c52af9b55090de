"""Refinement of estimates: which hypotheses are refined, and which refined pose is kept."""

from typing import Literal

import torch
from torch import Tensor

from foundpose.geometry import invert_transform
from foundpose.pipeline.hypotheses import HypothesisMaker
from foundpose.pipeline.results import PoseEstimates, PoseStatus
from foundpose.pipeline.selection import first_of_best
from foundpose.refinement import Observation, PoseProposals, PoseRefiner

RefineWhat = Literal["best", "all"] | int


def refine_estimates(
    estimates: PoseEstimates,
    observation: Observation,
    hypotheses: HypothesisMaker,
    refiner: PoseRefiner,
    refine: RefineWhat,
) -> PoseEstimates:
    """Refine the chosen hypothesis of each crop, all, or so many with the best scores; keep the best refined pose.

    A crop of which none could be refined keeps its coarse pose. Scores are those of the hypotheses' scorer, or the
    refiner's own where that looks at inliers only.
    """
    rank = _which(estimates, refine)
    num_inliers = estimates.hypotheses.num_inliers.gather(1, rank)
    proposals = _propose(estimates, rank)
    refined: PoseProposals = refiner(proposals, observation)
    score = hypotheses.score_refined(refined.T_crop_from_model, num_inliers, observation)
    if score is not None:
        refined = refined._replace(score=score)
    chosen = first_of_best(torch.where(refined.valid, refined.score.detach(), -torch.inf))
    found = refined.valid.any(dim=1) & estimates.valid

    def keep(x: Tensor, otherwise: Tensor) -> Tensor:
        """What belongs to the chosen pose of each crop."""
        index = chosen.reshape(-1, 1, *[1] * (x.dim() - 2))
        mine = torch.take_along_dim(x, index, dim=1).squeeze(1)
        return torch.where(found.reshape(-1, *[1] * (mine.dim() - 1)), mine, otherwise)

    T_camera_from_crop = invert_transform(estimates.crops.T_crop_from_camera)[:, None]
    return estimates._replace(
        T_camera_from_model=keep(
            T_camera_from_crop @ refined.T_crop_from_model, estimates.T_camera_from_model
        ),
        T_coarse=keep(T_camera_from_crop @ proposals.T_crop_from_model, estimates.T_coarse),
        score=keep(refined.score, torch.zeros_like(estimates.score)),
        num_inliers=keep(num_inliers, estimates.num_inliers),
        best=keep(rank, estimates.best),
        refined=refined,
    )


def _which(estimates: PoseEstimates, refine: RefineWhat) -> Tensor:
    """Numbers (B, n) of the hypotheses to refine."""
    hypotheses = estimates.hypotheses
    if refine == "best":
        return estimates.best[:, None]
    if refine == "all":
        return torch.arange(hypotheses.score.shape[1], device=estimates.best.device).expand_as(
            hypotheses.score
        )
    score = hypotheses.score.detach().masked_fill(hypotheses.status != PoseStatus.OK, -torch.inf)
    return score.sort(dim=1, descending=True, stable=True).indices[:, :refine]


def _propose(estimates: PoseEstimates, rank: Tensor) -> PoseProposals:
    """Some (B, n) of the hypotheses, to be refined."""
    hypotheses, crops = estimates.hypotheses, estimates.crops
    return PoseProposals(
        T_crop_from_model=torch.take_along_dim(hypotheses.T_crop_from_model, rank[..., None, None], dim=1),
        score=hypotheses.score.gather(1, rank).to(crops.K_crop.dtype),
        valid=(hypotheses.status.gather(1, rank) == PoseStatus.OK) & crops.valid[:, None],
        template_index=estimates.templates.index.gather(1, rank),
    )

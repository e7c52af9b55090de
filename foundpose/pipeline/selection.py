"""Which of several poses of a crop to keep."""

from typing import Literal

import torch
from torch import Tensor

from foundpose.geometry import invert_transform
from foundpose.pipeline.results import Hypothesised, PoseEstimates, PoseHypotheses, PoseStatus
from foundpose.refinement import Observation, PoseProposals
from foundpose.retrieval import RetrievedTemplates

RefineWhat = Literal["best", "all"]


def choose_coarse(
    observation: Observation, templates: RetrievedTemplates, found: Hypothesised
) -> PoseEstimates:
    """Keep the hypothesis with the best score; of equal ones, that of the more similar template."""
    crops, query, hypotheses = observation.crops, observation.query, found.hypotheses
    solved = hypotheses.status == PoseStatus.OK
    best = _first_of_best(hypotheses.score.detach().masked_fill(~solved, -torch.inf)).squeeze(1)
    row = torch.arange(len(best), device=best.device)
    status = hypotheses.status[row, best]
    status = torch.where(query.valid.any(dim=1), status, torch.full_like(status, PoseStatus.NO_PATCHES))
    status = torch.where(crops.valid, status, torch.full_like(status, PoseStatus.UNUSABLE_MASK))
    valid = status == PoseStatus.OK
    score = hypotheses.score[row, best]
    T = invert_transform(crops.T_crop_from_camera) @ hypotheses.T_crop_from_model[row, best]
    return PoseEstimates(
        T_camera_from_model=T,
        score=torch.where(valid, score, torch.zeros_like(score)),
        num_inliers=hypotheses.num_inliers[row, best] * valid,
        valid=valid,
        status=status,
        best=best,
        T_coarse=T,
        crops=crops,
        query=query,
        templates=templates,
        hypotheses=hypotheses,
        correspondences=found.correspondences,
        candidates=found.candidates,
    )


def hypotheses_to_refine(estimates: PoseEstimates, refine: RefineWhat) -> Tensor:
    """Indices (B, n) of the hypotheses to refine: the chosen one, or all."""
    B, h = estimates.hypotheses.num_inliers.shape
    if refine == "best":
        return estimates.best[:, None]
    return torch.arange(h, device=estimates.best.device).expand(B, h)


def propose(estimates: PoseEstimates, chosen: Tensor) -> PoseProposals:
    """Some (B, n) of the hypotheses, to be refined."""
    hypotheses, crops = estimates.hypotheses, estimates.crops
    return PoseProposals(
        T_crop_from_model=torch.take_along_dim(hypotheses.T_crop_from_model, chosen[..., None, None], dim=1),
        score=hypotheses.score.gather(1, chosen).to(crops.K_crop.dtype),
        valid=(hypotheses.status.gather(1, chosen) == PoseStatus.OK) & crops.valid[:, None],
        template_index=estimates.templates.index.gather(1, chosen),
    )


def choose_refined(
    estimates: PoseEstimates, proposals: PoseProposals, refined: PoseProposals, rank: Tensor
) -> PoseEstimates:
    """Keep the refined pose with the best score; a crop of which none could be refined keeps its coarse pose."""
    score = torch.where(refined.valid, refined.score.detach(), -torch.inf)
    chosen = _first_of_best(score)
    found = refined.valid.any(dim=1) & estimates.valid

    def take(x: Tensor) -> Tensor:
        index = chosen.reshape(-1, 1, *[1] * (x.dim() - 2))
        return torch.take_along_dim(x, index, dim=1).squeeze(1)

    T_camera_from_crop = invert_transform(estimates.crops.T_crop_from_camera)
    coarse = T_camera_from_crop @ take(proposals.T_crop_from_model)
    T = T_camera_from_crop @ take(refined.T_crop_from_model)
    best = torch.where(found, take(rank), estimates.best)
    num_inliers = estimates.hypotheses.num_inliers.gather(1, best[:, None]).squeeze(1)
    return estimates._replace(
        T_camera_from_model=torch.where(found[:, None, None], T, estimates.T_camera_from_model),
        T_coarse=torch.where(found[:, None, None], coarse, estimates.T_coarse),
        score=torch.where(found, take(refined.score), torch.zeros_like(estimates.score)),
        num_inliers=torch.where(found, num_inliers, estimates.num_inliers),
        best=best,
        refined=refined,
    )


def _first_of_best(score: Tensor) -> Tensor:
    """Places (B, 1) of the largest scores (B, n); of equal ones the first."""
    top = score.amax(dim=1, keepdim=True)
    place = torch.arange(score.shape[1], device=score.device).expand_as(score)
    return place.masked_fill(score < top, score.shape[1]).amin(dim=1, keepdim=True)


def better_of_two(ours: PoseHypotheses, theirs: PoseHypotheses) -> PoseHypotheses:
    """For each crop and template the hypothesis with the better score; of equal ones the first's."""
    a = ours.score.detach().masked_fill(ours.status != PoseStatus.OK, -torch.inf)
    b = theirs.score.detach().masked_fill(theirs.status != PoseStatus.OK, -torch.inf)

    def choose(x: Tensor, y: Tensor) -> Tensor:
        better = (b > a).reshape(*a.shape, *[1] * (x.dim() - a.dim()))
        return torch.where(better, y, x)

    return PoseHypotheses(*(choose(x, y) for x, y in zip(ours, theirs, strict=True)))

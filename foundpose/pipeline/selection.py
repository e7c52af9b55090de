"""Which of several poses of a crop to keep."""

import torch
from torch import Tensor

from foundpose.geometry import invert_transform
from foundpose.pipeline.results import Hypothesised, PoseEstimates, PoseHypotheses, PoseStatus
from foundpose.refinement import Observation
from foundpose.retrieval import RetrievedTemplates


def choose_coarse(
    observation: Observation, templates: RetrievedTemplates, found: Hypothesised
) -> PoseEstimates:
    """Keep the hypothesis with the best score; of equal ones, that of the more similar template."""
    crops, query, hypotheses = observation.crops, observation.query, found.hypotheses
    solved = hypotheses.status == PoseStatus.OK
    best = first_of_best(hypotheses.score.detach().masked_fill(~solved, -torch.inf)).squeeze(1)
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
        observation=observation,
    )


def first_of_best(score: Tensor) -> Tensor:
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

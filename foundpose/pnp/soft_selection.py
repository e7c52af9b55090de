"""A differentiable choice among pose hypotheses."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.pnp.cost import reprojection_errors
from foundpose.pnp.problem import PnpProblem


class PoseCandidates(NamedTuple):
    """Hypotheses of each problem with the probability of choosing them.

    Attributes:
        T_camera_from_model: (B, J, 4, 4), each polished on its own inliers; finite but meaningless where not valid.
        score: (B, J) soft numbers of inliers; 0 where not valid.
        probability: (B, J), sums to one over the valid candidates; zeros where a problem has none.
        valid: (B, J) bool.
    """

    T_camera_from_model: Tensor
    score: Tensor
    probability: Tensor
    valid: Tensor

    def expected(self, losses: Tensor) -> Tensor:
        """Expectation (B,) of losses (B, J), one for each candidate; zero for a problem without candidates.

        Differentiable w.r.t. the losses and, through the probabilities, w.r.t. the correspondences (DSAC).
        """
        return (self.probability * torch.where(self.valid, losses, torch.zeros_like(losses))).sum(-1)


class SoftInlierSelection(nn.Module):
    """Probabilistic choice of a hypothesis by its soft inlier count.

    A correspondence counts ``weight · sigmoid(sharpness · (threshold − error))`` towards a pose, and a pose is chosen
    with a probability proportional to ``exp(count / temperature)``. So the expected loss over the choice is
    differentiable with respect to the correspondences, those included that are outliers of the best pose.

    Args:
        num_candidates: number of hypotheses kept, those with the most inliers of all samples drawn; the others would
            have next to no probability.
        sharpness: slope of the soft count, per pixel.
        temperature: in inliers.

    Raises:
        ValueError: a setting out of range.

    Source: Brachmann et al., "DSAC - differentiable RANSAC for camera localization", CVPR 2017; the soft inlier count
    is that of Brachmann and Rother, "Learning less is more", CVPR 2018.
    """

    def __init__(self, num_candidates: int = 16, sharpness: float = 0.5, temperature: float = 10.0) -> None:
        super().__init__()
        if num_candidates < 1:
            raise ValueError(f"num_candidates must be at least 1, got {num_candidates}")
        if not sharpness > 0 or not temperature > 0:
            raise ValueError(f"sharpness and temperature must be positive, got {sharpness} and {temperature}")
        self.num_candidates = num_candidates
        self.sharpness = sharpness
        self.temperature = temperature

    def forward(
        self, T_camera_from_model: Tensor, found: Tensor, problem: PnpProblem, threshold: float
    ) -> PoseCandidates:
        """Score hypotheses.

        Args:
            T_camera_from_model: (B, J, 4, 4).
            found: (B, J) bool, which of them exist.
            problem: B clean problems.
            threshold: error that counts half, pixels.

        Returns:
            The candidates. Differentiable w.r.t. the poses, and the problem's points, ``K`` and weights.
        """
        squared, depth = reprojection_errors(T_camera_from_model, problem)
        counted = problem.valid.unsqueeze(1) & (depth > 0) & found.unsqueeze(-1)
        # A root at zero has no slope, and an error far beyond the threshold may overflow: both count a constant.
        limit = threshold + 50.0 / self.sharpness
        near = counted & (squared < limit**2) & (squared > 0)
        error = torch.where(near, squared, torch.ones_like(squared)).sqrt()
        error = torch.where(near, error, torch.where(squared > 0, limit, 0.0))
        share = torch.sigmoid(self.sharpness * (threshold - error)) * problem.weights.unsqueeze(1)
        score = torch.where(counted, share, torch.zeros_like(share)).sum(-1)
        return choose_softly(T_camera_from_model, score, found, self.temperature)

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"num_candidates={self.num_candidates}, sharpness={self.sharpness}, temperature={self.temperature}"


def choose_softly(T: Tensor, score: Tensor, valid: Tensor, temperature: float) -> PoseCandidates:
    """Probabilities of poses (B, J, 4, 4) with scores (B, J): a softmax over the valid ones."""
    logits = torch.where(valid, score / temperature, torch.full_like(score, -torch.inf))
    # A row without candidates would be a softmax over nothing.
    logits = torch.where(valid.any(-1, keepdim=True), logits, torch.zeros_like(logits))
    probability = torch.where(valid, torch.softmax(logits, dim=-1), torch.zeros_like(score))
    return PoseCandidates(T, score, probability, valid)

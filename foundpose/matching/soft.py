"""Soft matching: a distribution over the template's patches for each patch of the crop."""

import math

import torch
from torch import Tensor, nn

from foundpose.matching.base import Matcher, Matches
from foundpose.matching.probabilities import (
    AUTO_TEMPERATURE,
    Temperature,
    check_temperature,
    match_probabilities,
    needed_scale,
    point_confidence,
    point_moments,
)
from foundpose.representation import TemplatePatches
from foundpose.retrieval import QueryPatches


class SoftPatchMatcher(Matcher):
    """Matches each patch of a crop to the expected 3D point of each retrieved template.

    A template's patch j is the match of patch i with a probability proportional to ``exp(−‖q_i − t_j‖² / 2 τ²)``. The
    3D point is the expectation under these probabilities and its confidence is ``s² / (s² + v)``, with v the point's
    variance (summed over the three coordinates) and s the spacing of the template's patches on the object: inverse
    variance, as least squares wants it. As τ goes to 0 this becomes the nearest matcher with confidences of 1.

    An expectation is drawn towards the middle of the points that it averages, so a large τ shrinks the object and
    puts it at a wrong depth: keep τ well below the distance of neighbouring patches' descriptors.

    Args:
        temperature: τ, in the unit of the descriptors; or "auto": 0.15 of the median distance of right matches
            between the object's templates, which onboarding measures.
        learnable: make τ (by its logarithm) a parameter.

    Raises:
        ValueError: ``temperature`` is not positive; or automatic and to be learned.

    Source: soft nearest neighbours, Plötz and Roth, "Neural nearest neighbors networks", NeurIPS 2018.
    """

    log_temperature: Tensor

    def __init__(self, temperature: Temperature, learnable: bool = False) -> None:
        super().__init__()
        check_temperature(temperature)
        self.automatic = temperature == "auto"
        if self.automatic and learnable:
            raise ValueError("a temperature that is learned needs a number to start from, got 'auto'")
        self.learnable = learnable
        # An automatic one is a multiple of the object's scale.
        value = torch.tensor(math.log(AUTO_TEMPERATURE if temperature == "auto" else temperature))
        if learnable:
            self.log_temperature = nn.Parameter(value)
        else:
            self.register_buffer("log_temperature", value)

    @property
    def temperature(self) -> Tensor:
        """τ, a scalar tensor; an automatic one as a share of the right matches' distance."""
        return self.log_temperature.exp()

    def match_pairs(
        self, query: QueryPatches, template: TemplatePatches, match_distance: float | None
    ) -> Matches:
        """Expected points and confidences; ``template_patch`` is the most probable patch and ``distance`` that to its
        descriptor.

        Differentiable w.r.t. both descriptors, the points and the temperature, through ``points_model``, ``weight``
        and ``distance``.
        """
        q, t = query.descriptors, template.descriptors
        temperature = self.temperature.to(q.dtype)
        if self.automatic:
            temperature = temperature * needed_scale(match_distance)
        probability = match_probabilities(q, t, template.valid, temperature)
        expected, variance = point_moments(probability, template.points_model, template.valid)
        weight = point_confidence(variance, template.points_model, template.valid)
        patch = probability.detach().argmax(dim=-1)
        nearest = t.gather(1, patch.unsqueeze(-1).expand_as(q))
        distance = torch.linalg.vector_norm(q - nearest, dim=-1)
        valid = query.valid & template.valid.any(-1, keepdim=True)
        return Matches(patch, distance, valid, expected, weight, weight.detach())

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"temperature={self.temperature.item():g}, learnable={self.learnable}"

"""Soft matching: a distribution over the template's patches for each patch of the crop."""

import math
from typing import Literal

import torch
from torch import Tensor, nn

from foundpose.matching.base import Matches, check_patches

AUTO_TEMPERATURE = 0.15
"""Temperature as a share of the median distance of right matches, where it is to be measured."""


class SoftPatchMatcher(nn.Module):
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

    def __init__(self, temperature: float | Literal["auto"], learnable: bool = False) -> None:
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

    def forward(
        self,
        query_descriptors: Tensor,
        query_valid: Tensor,
        template_descriptors: Tensor,
        template_valid: Tensor,
        query_pixels: Tensor,
        template_points: Tensor,
        match_distance: float | None = None,
    ) -> Matches:
        """Match B crops with h templates each.

        Args:
            query_descriptors: (B, P, d).
            query_valid: (B, P) bool.
            template_descriptors: (B, h, Q, d).
            template_valid: (B, h, Q) bool.
            query_pixels: (B, P, 2) patch centres in the crop, pixels (not read).
            template_points: (B, h, Q, 3) the template patches' points, mesh units.
            match_distance: median distance of right matches; for an automatic temperature.

        Returns:
            One match per crop patch and template, with expected points and confidences; ``template_patch`` is the
            most probable patch and ``distance`` that to its descriptor. Not valid where the crop's patch is not or
            where the template has no valid patch. The memory is that of all B · h · P · Q probabilities.

        Raises:
            ValueError: If shapes do not fit.

        Differentiable w.r.t. both descriptors, ``template_points`` and the temperature, through ``points_model``,
        ``weight`` and ``distance``.
        """
        check_patches(
            query_descriptors,
            query_valid,
            template_descriptors,
            template_valid,
            query_pixels,
            template_points,
        )
        B, h, Q = template_valid.shape
        P = query_descriptors.shape[1]
        query = query_descriptors.unsqueeze(1).expand(-1, h, -1, -1).flatten(0, 1)
        template, t_valid = template_descriptors.flatten(0, 1), template_valid.flatten(0, 1)
        points = template_points.flatten(0, 1)
        if Q == 0 or P == 0:
            template, points = (x.new_zeros(B * h, max(Q, 1), x.shape[-1]) for x in (template, points))
            t_valid = t_valid.new_zeros(B * h, max(Q, 1))
        # What stands outside the masks must not matter, whatever it is.
        valid = query_valid.unsqueeze(1).expand(-1, h, -1).flatten(0, 1) & t_valid.any(-1, keepdim=True)
        query = query.masked_fill(~valid.unsqueeze(-1), 0.0)
        template, points = (x.masked_fill(~t_valid.unsqueeze(-1), 0.0) for x in (template, points))

        temperature = self.temperature.to(query.dtype)
        if self.automatic:
            temperature = temperature * needed_scale(match_distance)
        probability = match_probabilities(query, template, t_valid, temperature)
        expected, variance = point_moments(probability, points, t_valid)
        weight = point_confidence(variance, points, t_valid)
        patch = probability.detach().argmax(dim=-1) if P > 0 else valid.long()
        nearest = template.gather(1, patch.unsqueeze(-1).expand_as(query))
        distance = torch.linalg.vector_norm(query - nearest, dim=-1)
        return Matches(
            *(
                x.unflatten(0, (B, h))
                for x in (
                    patch.masked_fill(~valid, 0),
                    distance.masked_fill(~valid, torch.inf),
                    valid,
                    expected.masked_fill(~valid.unsqueeze(-1), 0.0),
                    weight.masked_fill(~valid, 0.0),
                    weight.detach().masked_fill(~valid, -torch.inf),
                )
            )
        )

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"temperature={self.temperature.item():g}, learnable={self.learnable}"


def needed_scale(match_distance: float | None) -> float:
    """The scale of an automatic temperature; raises ValueError without one."""
    if match_distance is None:
        raise ValueError("the temperature is auto: give match_distance, or set it to a number")
    return match_distance


def match_probabilities(
    query: Tensor, template: Tensor, template_valid: Tensor, temperature: Tensor | float
) -> Tensor:
    """Probability of each template patch to be the match of each query patch.

    Args:
        query: (n, P, d) descriptors.
        template: (n, Q, d) descriptors, finite.
        template_valid: (n, Q) bool.
        temperature: τ.

    Returns:
        (n, P, Q); rows sum to one over the valid patches, or are zero where there is none. Differentiable w.r.t. the
        descriptors and the temperature.
    """
    exists = template_valid.any(-1)[:, None, None]
    norm = template.square().sum(-1).masked_fill(~template_valid, torch.inf)
    # ‖q‖² is the same for all template patches.
    score = torch.baddbmm(norm.unsqueeze(1), query, template.transpose(1, 2), alpha=-2.0)
    score = torch.where(exists, score, torch.zeros_like(score))
    # Relative to the best before dividing, and divided twice: a tiny τ gives −inf, never inf − inf. The best one is a
    # constant, which a softmax does not see.
    score = score - score.detach().amin(-1, keepdim=True)
    # Distances at infinity carry no gradient, not 0 · inf.
    reachable = template_valid.unsqueeze(1) | ~exists
    score = torch.where(reachable, score, torch.zeros_like(score))
    logits = (score * -0.5 / temperature / temperature).masked_fill(~reachable, -torch.inf)
    return torch.softmax(logits, dim=-1) * exists


def point_moments(
    probability: Tensor, points: Tensor, valid: Tensor, centre: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Expected points and mean squared distances from them.

    Args:
        probability: (n, P, Q), rows that sum to one over the valid points.
        points: (n, Q, 3); those outside the mask may be anything.
        valid: (n, Q) bool.
        centre: (n, P, 3) points to measure the distances from, or None for the expected ones.

    Returns:
        Expected points (n, P, 3) and mean squared distances (n, P). Differentiable w.r.t. all arguments.
    """
    # Moments about the middle of the points: far from the origin, squares would leave float32 few digits.
    share = valid.unsqueeze(-1)
    points = points.masked_fill(~share, 0.0)
    middle = points.detach().sum(dim=1, keepdim=True) / share.sum(dim=1, keepdim=True).clamp(min=1)
    local = (points - middle) * share
    mean = probability @ local
    second = (probability @ local.square().sum(-1, keepdim=True)).squeeze(-1)
    if centre is None:
        variance = second - mean.square().sum(-1)
    else:
        offset = centre - middle
        variance = second - 2.0 * (mean * offset).sum(-1) + offset.square().sum(-1)
    return mean + middle, variance.clamp(min=0.0)


def point_confidence(variance: Tensor, points: Tensor, valid: Tensor) -> Tensor:
    """Confidence ``s² / (s² + v)`` of points with variance v on an object whose patches are s apart.

    Args:
        variance: (n, P), squared mesh units.
        points: (n, Q, 3) the template's points; those outside the mask may be anything.
        valid: (n, Q) bool.

    Returns:
        (n, P) in (0, 1]; 1 where the points have no extent. Differentiable w.r.t. all but the spacing.
    """
    points = points.detach().masked_fill(~valid.unsqueeze(-1), 0.0)
    share = valid.to(points.dtype).unsqueeze(-1)
    count = share.sum(1, keepdim=True).clamp(min=1.0)
    centred = (points - (share * points).sum(1, keepdim=True) / count) * share
    # A disc of this mean squared radius has the area 2π r², of which each patch takes its part.
    spacing = 2.0 * math.pi * centred.square().sum((1, 2)).unsqueeze(-1) / count.squeeze(-1).square()
    tiny = torch.finfo(points.dtype).tiny
    return (spacing + tiny) / (spacing + tiny + variance)


def check_temperature(temperature: float | str) -> None:
    """Raise ValueError unless the temperature is positive and finite, or "auto"."""
    if temperature == "auto":
        return
    if isinstance(temperature, str) or not 0.0 < temperature < math.inf:
        raise ValueError(f"temperature must be positive (in the unit of the descriptors), got {temperature}")

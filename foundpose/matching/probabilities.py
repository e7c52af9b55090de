"""Probabilities of matches, the points that they lead to, and how sure these are."""

import math
from typing import Literal

import torch
from torch import Tensor

Temperature = float | Literal["auto"]

AUTO_TEMPERATURE = 0.15
"""Temperature as a share of the median distance of right matches, where it is to be measured."""


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


def needed_scale(match_distance: float | None) -> float:
    """The scale of an automatic temperature; raises ValueError without one."""
    if match_distance is None:
        raise ValueError("the temperature is auto: give match_distance, or set it to a number")
    return match_distance

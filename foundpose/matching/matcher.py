"""Matching of crop patches to template patches by their descriptors."""

from typing import Literal

import torch
from torch import Tensor

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

MatchingMode = Literal["nearest", "cyclic"]

# Among matches whose cycles end as far away, those that are trusted sooner lie all over the crop: steps by the golden
# ratio. (An order by descriptor distance would hang on the last digit.)
_GOLDEN = 0.6180339887498949


def nearest_patches(
    query: Tensor, query_valid: Tensor, template: Tensor, template_valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Nearest valid template patch of each query patch, and the way back.

    Args:
        query: (n, P, d) descriptors.
        query_valid: (n, P) bool.
        template: (n, Q, d) descriptors.
        template_valid: (n, Q) bool.

    Returns:
        Template patch of each query patch (n, P), and the nearest valid query patch of that template patch
        (n, P). Of equally near patches the one with the lowest index; meaningless where there is none.

    Not differentiable (indices).
    """
    query, template = query.detach(), template.detach()
    template_norm = template.square().sum(dim=-1).masked_fill(~template_valid, torch.inf)
    # |q|² is the same for all template patches, so one direction does not need it.
    score = torch.baddbmm(template_norm.unsqueeze(1), query, template.transpose(1, 2), alpha=-2.0)
    forth = score.argmin(dim=2)
    query_norm = query.square().sum(dim=-1).masked_fill(~query_valid, torch.inf)
    back = (score + query_norm.unsqueeze(2)).argmin(dim=1)
    return forth, back.gather(1, forth)


def keep_best(valid: Tensor, cycle: Tensor | None, distance: Tensor, top_k: int) -> Tensor:
    """Mask of the ``top_k`` matches with the smallest cycle distance, then descriptor distance, then index.

    Args:
        valid: (..., P) bool, candidates.
        cycle: (..., P) cycle distances in pixels, or None to rank by descriptor distance alone.
        distance: (..., P) descriptor distances.
        top_k: number of matches to keep.

    Returns:
        (..., P) bool, a subset of ``valid``.
    """
    # Lexicographic order: stable sorts from the last key to the first. Not valid: +inf, so last.
    order = distance.detach().masked_fill(~valid, torch.inf).sort(dim=-1, stable=True).indices
    if cycle is not None:
        by_distance = cycle.detach().masked_fill(~valid, torch.inf).gather(-1, order)
        order = order.gather(-1, by_distance.sort(dim=-1, stable=True).indices)
    return torch.zeros_like(valid).scatter(-1, order[..., :top_k], True) & valid


class PatchMatcher(Matcher):
    """Matches each patch of a crop to the nearest patch (Euclidean) of each retrieved template.

    Args:
        mode: "nearest": one-way nearest neighbour (the paper). "cyclic": matches are ranked by the distance
            in the crop between a patch and the patch to which the template's patch matches back.
        top_k: keep this many matches per template, the best first by cycle distance (in mode "cyclic"), then by
            descriptor distance, then by index; None keeps all, and then both modes give the same.
        confidence_temperature: gives each match the confidence that :class:`SoftPatchMatcher` has at this temperature
            that the patch lies where it was matched to, so that a pose estimated from the weighted matches has a
            gradient in the descriptors; "auto" as there. None: all matches weigh the same (the paper), and a pose
            has none.

    Source: paper, "Crop-to-template patch matching"; cyclic: Goodwin et al., ECCV 2022.
    """

    def __init__(
        self,
        mode: MatchingMode = "nearest",
        top_k: int | None = None,
        confidence_temperature: Temperature | None = None,
    ) -> None:
        super().__init__()
        if mode not in ("nearest", "cyclic"):
            raise ValueError(f"mode must be 'nearest' or 'cyclic', got {mode!r}")
        if top_k is not None and top_k < 1:
            raise ValueError(f"top_k must be at least 1 or None, got {top_k}")
        if confidence_temperature is not None:
            check_temperature(confidence_temperature)
        self.mode = mode
        self.top_k = top_k
        self.confidence_temperature: Temperature | None = confidence_temperature

    def match_pairs(
        self, query: QueryPatches, template: TemplatePatches, match_distance: float | None
    ) -> Matches:
        """Nearest patches, the ``top_k`` best of them.

        Differentiable w.r.t. the descriptors through ``distance`` and (with a ``confidence_temperature``) ``weight``,
        and w.r.t. the points; the choice of patches is constant.
        """
        q, t, points = query.descriptors, template.descriptors, template.points_model
        forth, back = nearest_patches(q, query.valid, t, template.valid)
        nearest = t.gather(1, forth.unsqueeze(-1).expand_as(q))
        # From the difference, not from the expanded square: accurate near zero.
        distance = torch.linalg.vector_norm(q - nearest, dim=-1)
        returned = query.pixels.gather(1, back.unsqueeze(-1).expand_as(query.pixels))
        cycle = torch.linalg.vector_norm(query.pixels - returned, dim=-1)
        valid = query.valid & template.valid.any(dim=1, keepdim=True)
        if self.top_k is not None:
            valid = keep_best(valid, cycle if self.mode == "cyclic" else None, distance, self.top_k)
        spread = (torch.arange(q.shape[1], device=q.device, dtype=torch.float64) * _GOLDEN).frac()
        chosen = points.gather(1, forth.unsqueeze(-1).expand(-1, -1, 3))
        weight = torch.ones_like(distance)
        temperature = self.confidence_temperature
        if temperature is not None:
            if temperature == "auto":
                temperature = AUTO_TEMPERATURE * needed_scale(match_distance)
            probability = match_probabilities(q, t, template.valid, temperature)
            _, variance = point_moments(probability, points, template.valid, chosen)
            weight = point_confidence(variance, points, template.valid)
        return Matches(forth, distance, valid, chosen, weight, -cycle - spread.to(cycle))

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"mode={self.mode!r}, top_k={self.top_k}, confidence_temperature={self.confidence_temperature}"

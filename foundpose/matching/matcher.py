"""Matching of crop patches to template patches by their descriptors."""

from typing import Literal

import torch
from torch import Tensor, nn

from foundpose.matching.base import Matches, check_patches
from foundpose.matching.soft import (
    AUTO_TEMPERATURE,
    check_temperature,
    match_probabilities,
    needed_scale,
    point_confidence,
    point_moments,
)

MatchingMode = Literal["nearest", "cyclic"]

# Among matches whose cycles end as far away, those that are trusted sooner lie all over the crop: steps by the golden
# ratio. (An order by descriptor distance would hang on the last digit.)
_GOLDEN = 0.6180339887498949

# Distances between all patches exist for one block of (crop, template) pairs at a time: 64 MiB in float32.
_DISTANCES_PER_BLOCK = 1 << 24


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


def match_patches(
    query: Tensor,
    query_valid: Tensor,
    template: Tensor,
    template_valid: Tensor,
    query_pixels: Tensor,
    template_points: Tensor,
    mode: MatchingMode,
    top_k: int | None,
    temperature: float | None = None,
) -> Matches:
    """Match B crops to h templates each; shapes as in `PatchMatcher.forward`.

    Args:
        query: (B, P, d), finite.
        query_valid: (B, P) bool.
        template: (B, h, Q, d), finite.
        template_valid: (B, h, Q) bool.
        query_pixels: (B, P, 2).
        template_points: (B, h, Q, 3), finite.
        mode: whether ``top_k`` ranks by cycle distance.
        top_k: number of matches to keep per template, or None for all.
        temperature: of the confidences, or None for ones.

    Returns:
        The matches. Differentiable w.r.t. the descriptors through distances and weights, and w.r.t. the points.
    """
    B, h, Q = template_valid.shape
    P = query.shape[1]
    if min(B, h, P, Q) == 0:
        nothing = query_valid.new_zeros(B, h, P)
        zero = query.new_zeros(B, h, P)
        points = template_points.new_zeros(B, h, P, 3)
        return Matches(nothing.long(), zero + torch.inf, nothing, points, zero, zero - torch.inf)
    template, template_valid = template.flatten(0, 1), template_valid.flatten(0, 1)
    points = template_points.flatten(0, 1)
    crop = torch.arange(B * h, device=query.device) // h
    blocks = []
    rows = max(1, _DISTANCES_PER_BLOCK // (P * Q))
    for block in (slice(first, first + rows) for first in range(0, B * h, rows)):
        mine = crop[block]
        q, q_valid = query.index_select(0, mine), query_valid[mine]
        t, t_valid, x = template[block], template_valid[block], points[block]
        forth, back = nearest_patches(q, q_valid, t, t_valid)
        ok = q_valid & t_valid.any(dim=1, keepdim=True)
        nearest = t.gather(1, forth.unsqueeze(-1).expand_as(q))
        # From the difference, not from the expanded square: accurate near zero.
        length = torch.linalg.vector_norm(q - nearest, dim=-1)
        pixels = query_pixels[mine]
        cycle = torch.linalg.vector_norm(
            pixels - pixels.gather(1, back.unsqueeze(-1).expand_as(pixels)), dim=-1
        )
        if top_k is not None:
            ok = keep_best(ok, cycle if mode == "cyclic" else None, length, top_k)
        spread = (torch.arange(P, device=query.device, dtype=torch.float64) * _GOLDEN).frac()
        priority = -cycle - spread.to(cycle)
        chosen = x.gather(1, forth.unsqueeze(-1).expand(-1, -1, 3))
        if temperature is None:
            weight = torch.ones_like(length)
        else:
            t = t.masked_fill(~t_valid.unsqueeze(-1), 0.0)
            probability = match_probabilities(q, t, t_valid, temperature)
            weight = point_confidence(point_moments(probability, x, t_valid, chosen)[1], x, t_valid)
        blocks.append(
            Matches(
                forth.masked_fill(~ok, 0),
                length.masked_fill(~ok, torch.inf),
                ok,
                chosen.masked_fill(~ok.unsqueeze(-1), 0.0),
                weight.masked_fill(~ok, 0.0),
                priority.masked_fill(~ok, -torch.inf),
            )
        )
    return Matches(*(torch.cat(parts).unflatten(0, (B, h)) for parts in zip(*blocks, strict=True)))


class PatchMatcher(nn.Module):
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
        confidence_temperature: float | Literal["auto"] | None = None,
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
        self.confidence_temperature: float | Literal["auto"] | None = confidence_temperature

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
            query_pixels: (B, P, 2) patch centres in the crop, pixels.
            template_points: (B, h, Q, 3) the template patches' points, mesh units.
            match_distance: median distance of right matches; for an automatic temperature.

        Returns:
            One match per crop patch and template; not valid where the patch is not, where the template has no
            valid patch, or where ``top_k`` better ones exist. What stands in rows that are not valid (as long
            as it is finite) has no influence.

        Raises:
            ValueError: If shapes do not fit.

        Differentiable w.r.t. the descriptors through ``distance`` and (with a ``confidence_temperature``) ``weight``,
        and w.r.t. ``template_points``; the choice of patches is constant.
        """
        check_patches(
            query_descriptors,
            query_valid,
            template_descriptors,
            template_valid,
            query_pixels,
            template_points,
        )
        temperature = self.confidence_temperature
        if temperature == "auto":
            temperature = AUTO_TEMPERATURE * needed_scale(match_distance)
        return match_patches(
            query_descriptors,
            query_valid,
            template_descriptors,
            template_valid,
            query_pixels,
            template_points,
            self.mode,
            self.top_k,
            temperature,
        )

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"mode={self.mode!r}, top_k={self.top_k}, confidence_temperature={self.confidence_temperature}"

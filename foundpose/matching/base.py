"""What matching returns, and the contract of matchers."""

from abc import ABC, abstractmethod
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from foundpose.representation import TemplatePatches
from foundpose.retrieval import QueryPatches

Patches = TypeVar("Patches", QueryPatches, TemplatePatches)

# Distances between all patches exist for one block of (crop, template) pairs at a time: 64 MiB in float32.
_DISTANCES_PER_BLOCK = 1 << 24


class Matches(NamedTuple):
    """Matches of the patches of B crops to the patches of h templates each.

    Attributes:
        template_patch: (B, h, P) index into the template's (padded) patches, int64; 0 where not valid.
        distance: (B, h, P) Euclidean distance of the descriptors; +inf where not valid.
        valid: (B, h, P) bool.
        points_model: (B, h, P, 3) 3D point that the crop's patch is matched to, mesh units; zero where not valid.
        weight: (B, h, P) confidence of the match in (0, 1]; 0 where not valid.
        priority: (B, h, P) order in which to trust matches, the larger the sooner; −inf where not valid. For RANSAC's
            samples; a constant.
    """

    template_patch: Tensor
    distance: Tensor
    valid: Tensor
    points_model: Tensor
    weight: Tensor
    priority: Tensor


class Matcher(nn.Module, ABC):
    """Matches the patches of crops to those of templates; each pair of a crop and a template on its own."""

    def forward(
        self, query: QueryPatches, template: TemplatePatches, match_distance: float | None = None
    ) -> Matches:
        """Match B crops with h templates each.

        Args:
            query: P patches of each of B crops.
            template: Q patches of each of (B, h) templates; their pixels do not matter.
            match_distance: median distance of right matches; for an automatic temperature.

        Returns:
            One match per crop patch and template; not valid where the patch is not, where the template has no
            valid patch, or where the matcher leaves it out. What stands in rows that are not valid has no influence.

        Raises:
            ValueError: If shapes do not fit.

        Differentiable w.r.t. the descriptors of both and the template's points, as the matcher says.
        """
        _check(query, template)
        B, h, Q = template.valid.shape
        P = query.valid.shape[1]
        if min(B, h, P, Q) == 0:
            valid, zero = query.valid.new_zeros(B, h, P), query.descriptors.new_zeros(B, h, P)
            points = template.points_model.new_zeros(B, h, P, 3)
            return _only_valid(Matches(valid.long(), zero, valid, points, zero, zero))
        crop = torch.arange(B * h, device=query.descriptors.device) // h
        templates = [x.flatten(0, 1) for x in template]
        blocks = []
        rows = max(1, _DISTANCES_PER_BLOCK // (P * Q))
        for first in range(0, B * h, rows):
            mine = crop[first : first + rows]
            q = _masked(QueryPatches(query.descriptors[mine], query.pixels[mine], query.valid[mine]))
            t = _masked(TemplatePatches(*(x[first : first + rows] for x in templates)))
            t = t._replace(points_model=t.points_model.masked_fill(~t.valid.unsqueeze(-1), 0.0))
            blocks.append(_only_valid(self.match_pairs(q, t, match_distance)))
        return Matches(*(torch.cat(parts).unflatten(0, (B, h)) for parts in zip(*blocks, strict=True)))

    @abstractmethod
    def match_pairs(
        self, query: QueryPatches, template: TemplatePatches, match_distance: float | None
    ) -> Matches:
        """Match n crops (n, P, ·) with one template (n, Q, ·) each; rows that are not valid are zero.

        Returns:
            Matches (n, P, ·), which may be anything where not valid.
        """


def _masked(patches: Patches) -> Patches:
    """Patches with descriptors of zero where not valid."""
    descriptors = patches.descriptors.masked_fill(~patches.valid.unsqueeze(-1), 0.0)
    return patches._replace(descriptors=descriptors)


def _only_valid(matches: Matches) -> Matches:
    out = ~matches.valid
    return Matches(
        matches.template_patch.masked_fill(out, 0),
        matches.distance.masked_fill(out, torch.inf),
        matches.valid,
        matches.points_model.masked_fill(out.unsqueeze(-1), 0.0),
        matches.weight.masked_fill(out, 0.0),
        matches.priority.masked_fill(out, -torch.inf),
    )


def _check(query: QueryPatches, template: TemplatePatches) -> None:
    """Raise ValueError unless the shapes are those of :meth:`Matcher.forward`."""
    q, t = query.descriptors, template.descriptors
    if q.ndim != 3 or t.ndim != 4 or t.shape[0] != q.shape[0] or t.shape[3] != q.shape[2]:
        raise ValueError(
            "descriptors must have shapes (B, P, d) for crops and (B, h, Q, d) for templates, got "
            f"{tuple(q.shape)} and {tuple(t.shape)}"
        )
    for name, mask, expected in (
        ("query.valid", query.valid, q.shape[:2]),
        ("template.valid", template.valid, t.shape[:3]),
    ):
        if mask.shape != expected or mask.dtype != torch.bool:
            raise ValueError(
                f"{name} must be bool of shape {tuple(expected)}, got {tuple(mask.shape)} {mask.dtype}"
            )
    for name, points, shape in (
        ("query.pixels", query.pixels, (*q.shape[:2], 2)),
        ("template.points_model", template.points_model, (*t.shape[:3], 3)),
    ):
        if points.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(points.shape)}")

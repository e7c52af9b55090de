"""Scales of an object's descriptors, measured on its templates: no setting of a later stage needs to be guessed."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.representation.object_representation import ObjectRepresentation
from foundpose.retrieval.base import normalize_rows
from foundpose.retrieval.bow import nearest_words

# Patches of neighbouring templates see the same point if theirs are nearer than this share of the patches' spacing.
_SAME_POINT = 0.25
_MOST_TEMPLATES = 100
_MOST_PATCHES = 20_000
# Makes the median magnitude of normally distributed numbers their standard deviation.
_TO_DEVIATION = 1.4826


class TrueMatches(NamedTuple):
    """Patches of neighbouring templates that see the same point of the object.

    Attributes:
        first: (n,) rows of the object's descriptors.
        second: (n,) rows of the patches that they match.
    """

    first: Tensor
    second: Tensor


class DescriptorScales(NamedTuple):
    """Scales of an object's projected descriptors, in their unit; None where the templates show none.

    Attributes:
        word: median distance of a patch from its nearest visual word.
        match: median distance of the descriptors of right matches.
        channel: robust standard deviation of the difference of right matches in one component.
        unit: median distance of the descriptors of right matches, scaled to unit length.
    """

    word: float | None
    match: float | None
    channel: float | None
    unit: float | None

    def known(self) -> dict[str, float]:
        """Those that are there, by name."""
        return {name: value for name, value in self._asdict().items() if value is not None}


def true_matches(representation: ObjectRepresentation) -> TrueMatches:
    """Right matches between templates and the templates nearest to them, from their patches' 3D points alone.

    At most 100 templates, evenly spread, are compared with their neighbours.
    """
    T = representation.T_template_from_model
    device, total = T.device, representation.num_templates
    chosen = torch.arange(min(total, _MOST_TEMPLATES), device=device) * total // min(total, _MOST_TEMPLATES)
    views = representation.nearest_views(T[chosen], 2)
    # The nearest is the template itself.
    neighbour = torch.where(views[:, 0] == chosen, views[:, -1], views[:, 0])
    first, second = [], []
    offsets = representation.template_offsets.tolist()
    for a, b in zip(chosen.tolist(), neighbour.tolist(), strict=True):
        mine, theirs = slice(offsets[a], offsets[a + 1]), slice(offsets[b], offsets[b + 1])
        points, others = representation.points_model[mine], representation.points_model[theirs]
        if a == b or not len(points) or not len(others):
            continue
        depth = (points @ T[a, 2, :3] + T[a, 2, 3]).median()
        spacing = representation.info.stride * depth / representation.K_template[a, 0, 0]
        nearest = torch.cdist(points, others).min(dim=1)
        same = (nearest.values < _SAME_POINT * spacing).nonzero().squeeze(1)
        first.append(same + mine.start)
        second.append(nearest.indices[same] + theirs.start)
    nothing = torch.zeros(0, dtype=torch.int64, device=device)
    return TrueMatches(torch.cat([nothing, *first]), torch.cat([nothing, *second]))


def measure_scales(representation: ObjectRepresentation) -> DescriptorScales:
    """Measure the scales of an object's descriptors on its templates.

    Source: patches of neighbouring templates whose 3D points coincide are right matches, for free.
    """
    rows = torch.arange(len(representation.descriptors), device=representation.words.device)
    rows = rows[:: max(1, len(rows) // _MOST_PATCHES)]
    words = nearest_words(representation.read_descriptors(rows), representation.words, 1)[0]
    pairs = true_matches(representation)
    x, y = representation.read_descriptors(pairs.first), representation.read_descriptors(pairs.second)
    unit = torch.linalg.vector_norm(normalize_rows(x) - normalize_rows(y), dim=1)
    return DescriptorScales(
        word=_median(words.sqrt()),
        match=_median(torch.linalg.vector_norm(x - y, dim=1)),
        channel=_median(_TO_DEVIATION * (x - y).abs()),
        unit=_median(unit),
    )


def _median(x: Tensor) -> float | None:
    """None for no numbers, and for a scale of zero, which would divide by it."""
    value = float(x.flatten().median()) if x.numel() else 0.0
    return value if value > 0 else None

"""Re-ranking of retrieved templates by patches that look alike and lie alike."""

from typing import Literal, get_args

import torch
from torch import Tensor

from foundpose.geometry.similarity import (
    InPlane,
    apply_similarity,
    fit_similarity_robustly,
    identity_similarity,
)
from foundpose.retrieval.base import (
    QueryPatches,
    RetrievedTemplates,
    Retriever,
    TemplateIndex,
    normalize_rows,
)

Alignment = Literal["none"] | InPlane

# What a cell of distance costs while template and crop are brought together, before it costs ``position_weight``.
_EARLY_WEIGHTS = (0.25, 0.5)
# Distances in cells at which a pair of patches counts a half, in each fit.
_FIT_SCALES = (2.0, 1.5, 1.5)
# Similarities of a patch with all patches of all candidates exist for a few crops at a time: 16 MiB in float32.
_SIMILARITIES_PER_BLOCK = 1 << 22


class SpatialReranker(Retriever):
    """Keeps those of a retriever's templates whose patches look like the crop's and lie at the same places.

    Crop and template are framed alike, so the patches of the right template are found near where the crop has them. A
    template's score is the mean over the crop's patches of ``max_j (cosine_ij − w · distance_ij)`` over the
    template's patches j, with distances in cells of the patch grid. What hides a part of the object or of its mask
    moves and scales the crop; so the template is first aligned with the crop by a similarity transform, found from
    the best pairs.

    Args:
        retriever: finds candidates; its ``num_templates`` is their number.
        num_templates: number h of templates per crop that are kept.
        position_weight: w, what a cell of distance costs; 0 compares descriptors alone.
        max_patches: at most this many patches of a crop, evenly spread, are compared; None for all.
        components: so many leading PCA components of the descriptors are compared; None for all.
        alignment: what may move before templates are compared: nothing ("none"), a "shift", a shift and a "scale", or
            a rotation in the plane as well ("similarity").

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(
        self,
        retriever: Retriever,
        num_templates: int = 5,
        position_weight: float = 0.2,
        alignment: Alignment = "similarity",
        max_patches: int | None = 96,
        components: int | None = 64,
    ) -> None:
        super().__init__(num_templates)
        for name, value in (("max_patches", max_patches), ("components", components)):
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1 or None, got {value}")
        if not position_weight >= 0:
            raise ValueError(f"position_weight must not be negative, got {position_weight}")
        known = ("none", *get_args(InPlane))
        if alignment not in known:
            raise ValueError(f"alignment must be one of {known}, got {alignment!r}")
        if retriever.num_templates < num_templates:
            raise ValueError(
                f"the retriever finds {retriever.num_templates} candidates, of which {num_templates} templates "
                f"cannot "
                "be kept: raise its num_templates"
            )
        self.retriever = retriever
        self.position_weight = position_weight
        self.alignment: Alignment = alignment
        self.max_patches = max_patches
        self.components = components

    def forward(self, query: QueryPatches, index: TemplateIndex) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: patches of B crops.
            index: the object.

        Returns:
            The h best of each crop's candidates by the score above, which is their ``similarity``.

        Raises:
            ValueError: as the retriever.

        Differentiable w.r.t. ``query.descriptors`` and the object's descriptors through ``similarity``; which patches
        are paired, and so how the template is aligned, is constant, and so is the choice of templates.
        """
        found: RetrievedTemplates = self.retriever(query, index)
        score = self.scores(query, index, found)
        kept = score.detach().sort(dim=1, descending=True, stable=True).indices[:, : self.num_templates]
        best = score.gather(1, kept)
        return RetrievedTemplates(found.index.gather(1, kept), best, found.valid.gather(1, kept))

    def scores(self, query: QueryPatches, index: TemplateIndex, candidates: RetrievedTemplates) -> Tensor:
        """Scores (B, h) of candidates; −inf where not valid. Differentiable as :meth:`forward`."""
        query = _spread(query, self.max_patches)
        per_crop = candidates.index.shape[1] * max(index.max_patches, 1) * max(query.valid.shape[1], 1)
        step = max(1, _SIMILARITIES_PER_BLOCK // per_crop)
        blocks = [slice(first, first + step) for first in range(0, len(query.valid), step)]
        parts = [self._scores(query, index, candidates, rows) for rows in blocks]
        return torch.cat([candidates.similarity[:0], *parts])

    def _scores(
        self, query: QueryPatches, index: TemplateIndex, candidates: RetrievedTemplates, rows: slice
    ) -> Tensor:
        """Scores of some of the crops."""
        valid = query.valid[rows]
        patches = index.gather_templates(candidates.index[rows], self.components)
        x = query.descriptors[rows, :, : self.components].masked_fill(~valid.unsqueeze(-1), 0.0)
        x = normalize_rows(x)
        cosine = x.unsqueeze(1) @ normalize_rows(patches.descriptors.to(x)).transpose(-1, -2)  # (b, h, P, Q)
        # No patch is worse than the opposite at the far end of the crop.
        lowest = -2.0 - 2.0 * self.position_weight * index.info.grid
        cosine = cosine.masked_fill(~patches.valid.unsqueeze(2), lowest)
        best = cosine
        if self.position_weight > 0:
            stride = index.info.stride
            at_crop = (query.pixels[rows] / stride).unsqueeze(1).expand(-1, cosine.shape[1], -1, -1)
            at_template = patches.pixels.to(at_crop) / stride
            placed = self._align(cosine.detach(), at_crop, at_template, valid)
            best = cosine - self.position_weight * _distances(at_crop, placed)
        matched = best.amax(dim=3).masked_fill(~valid.unsqueeze(1), 0.0)
        score = matched.sum(dim=2) / valid.sum(dim=1, keepdim=True).clamp(min=1)
        usable = candidates.valid[rows] & patches.valid.any(dim=2)
        return score.masked_fill(~usable, -torch.inf)

    def _align(self, cosine: Tensor, at_crop: Tensor, at_template: Tensor, valid: Tensor) -> Tensor:
        """Places (b, h, Q, 2) of the templates' patches once they are aligned with the crop, in cells."""
        if self.alignment == "none":
            return at_template
        A = identity_similarity(at_template)
        for early in (*_EARLY_WEIGHTS, 1.0):
            placed = apply_similarity(A, at_template)
            nearest = (cosine - early * self.position_weight * _distances(at_crop, placed)).max(dim=3)
            source = at_template.gather(2, nearest.indices.unsqueeze(-1).expand_as(at_crop))
            alike = cosine.gather(3, nearest.indices.unsqueeze(-1)).squeeze(-1).clamp(min=0.0)
            weight = alike.square() * valid.unsqueeze(1)
            A = fit_similarity_robustly(source, at_crop, weight, _FIT_SCALES, self.alignment, A)
        return apply_similarity(A, at_template)

    def onboarding_settings(self) -> dict[str, str]:
        """Those of the retriever."""
        return self.retriever.onboarding_settings()

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return (
            f"num_templates={self.num_templates}, position_weight={self.position_weight}, "
            f"alignment={self.alignment!r}, max_patches={self.max_patches}, components={self.components}"
        )


def _spread(query: QueryPatches, most: int | None) -> QueryPatches:
    """At most so many of each crop's valid patches, which come first, evenly spread over them."""
    if most is None or query.valid.shape[1] <= most:
        return query
    place = torch.arange(most, device=query.valid.device)
    count = query.valid.sum(dim=1, keepdim=True)
    number = count.clamp(max=most)
    chosen = ((place * count) // number.clamp(min=1)).clamp(max=query.valid.shape[1] - 1)
    return query._replace(
        descriptors=torch.take_along_dim(query.descriptors, chosen.unsqueeze(-1), dim=1),
        pixels=torch.take_along_dim(query.pixels, chosen.unsqueeze(-1), dim=1),
        valid=place < number,
    )


def _distances(x: Tensor, y: Tensor) -> Tensor:
    """Distances (..., P, Q) of points (..., P, 2) and (..., Q, 2)."""
    squared = (x[..., 0].unsqueeze(-1) - y[..., 0].unsqueeze(-2)).square_()
    squared += (x[..., 1].unsqueeze(-1) - y[..., 1].unsqueeze(-2)).square_()
    return squared.sqrt_()

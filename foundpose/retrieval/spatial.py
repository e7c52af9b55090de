"""Re-ranking of retrieved templates by patches that look alike and lie alike."""

from typing import Literal, get_args

import torch
from torch import Tensor

from foundpose.geometry.similarity import InPlane, fit_similarity_robustly, identity_similarity
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval.base import (
    QueryPatches,
    RetrievedTemplates,
    Retriever,
    normalize_rows,
    spread_patches,
)

Alignment = Literal["none"] | InPlane

# What a cell of distance costs while template and crop are brought together, as shares of ``position_weight``: of the
# squared distance, over this many cells, which one matrix product gives for all pairs.
_ALIGNMENT_WEIGHTS = (0.25, 0.5, 1.0)
_ALIGNMENT_CELLS = 4.0
# Distances in cells at which a pair of patches counts a half, in each fit.
_FIT_SCALES = (2.0, 1.5)
# So many of the crop's patches align it with a template.
_ALIGNMENT_PATCHES = 32
# Similarities of a patch with all patches of all candidates exist for a few crops at a time: what a cache holds.
_SIMILARITIES_PER_BLOCK = 1 << 21
# Where padding lies, in cells: it is never the nearest.
_FAR_AWAY = 1e4


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
        max_patches: int | None = 64,
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
                "cannot be kept: raise its num_templates"
            )
        self.retriever = retriever
        self.position_weight = position_weight
        self.alignment: Alignment = alignment
        self.max_patches = max_patches
        self.components = components

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
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

    def scores(
        self, query: QueryPatches, index: ObjectRepresentation, candidates: RetrievedTemplates
    ) -> Tensor:
        """Scores (B, h) of candidates; −inf where not valid. Differentiable as :meth:`forward`."""
        query = spread_patches(query, self.max_patches)
        per_crop = candidates.index.shape[1] * max(index.max_patches, 1) * max(query.valid.shape[1], 1)
        step = max(1, _SIMILARITIES_PER_BLOCK // per_crop)
        blocks = [slice(first, first + step) for first in range(0, len(query.valid), step)]
        parts = [self._scores(query, index, candidates, rows) for rows in blocks]
        return torch.cat([candidates.similarity[:0], *parts])

    def _scores(
        self, query: QueryPatches, index: ObjectRepresentation, candidates: RetrievedTemplates, rows: slice
    ) -> Tensor:
        """Scores of some of the crops."""
        valid = query.valid[rows]
        patches = index.gather_templates(candidates.index[rows], self.components)
        x = query.descriptors[rows, :, : self.components].masked_fill(~valid.unsqueeze(-1), 0.0)
        x = normalize_rows(x).unsqueeze(1)
        cosine = x @ normalize_rows(patches.descriptors.to(x)).transpose(-1, -2)  # (b, h, P, Q)
        if self.position_weight > 0:
            to_map = index.info.patch_grid.to_map
            at_crop = to_map(query.pixels[rows]).unsqueeze(1).expand(-1, cosine.shape[1], -1, -1)
            at_template = to_map(patches.pixels.to(at_crop)).masked_fill(
                ~patches.valid.unsqueeze(-1), _FAR_AWAY
            )
            with torch.no_grad():
                A = self._align(cosine.detach(), at_crop, at_template, valid)
                left, right = _squared_distances(A, at_crop, at_template)
                distance = (left @ right).clamp_(min=0.0).sqrt_()
            best = -distance.mul_(self.position_weight).sub_(cosine).amin(dim=3)
        else:
            best = cosine.masked_fill(~patches.valid.unsqueeze(2), -_FAR_AWAY).amax(dim=3)
        matched = best.masked_fill(~valid.unsqueeze(1), 0.0)
        score = matched.sum(dim=2) / valid.sum(dim=1, keepdim=True).clamp(min=1)
        usable = candidates.valid[rows] & patches.valid.any(dim=2)
        return score.masked_fill(~usable, -torch.inf)

    def _align(self, cosine: Tensor, at_crop: Tensor, at_template: Tensor, valid: Tensor) -> Tensor:
        """Transforms (b, h, 2, 3) that bring the templates' patches to the crop's, in cells."""
        A = identity_similarity(at_template)
        if self.alignment == "none":
            return A
        few = slice(_ALIGNMENT_PATCHES)
        cosine, at_crop = cosine[:, :, few].contiguous(), at_crop[:, :, few]
        for weight in _ALIGNMENT_WEIGHTS:
            left, right = _squared_distances(A, at_crop, at_template)
            cost = weight * self.position_weight / _ALIGNMENT_CELLS
            score = torch.baddbmm(*(x.flatten(0, 1) for x in (cosine, left, right)), alpha=-cost)
            nearest = score.argmax(dim=2).view(at_crop.shape[:-1]).unsqueeze(-1)
            source = at_template.gather(2, nearest.expand_as(at_crop))
            alike = cosine.gather(3, nearest).squeeze(-1).clamp(min=0.0)
            trust = alike.square() * valid[:, few].unsqueeze(1)
            A = fit_similarity_robustly(source, at_crop, trust, _FIT_SCALES, self.alignment, A)
        return A

    def onboarding_settings(self) -> dict[str, str]:
        """Those of the retriever."""
        return self.retriever.onboarding_settings()

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return (
            f"num_templates={self.num_templates}, position_weight={self.position_weight}, "
            f"alignment={self.alignment!r}, max_patches={self.max_patches}, components={self.components}"
        )


def _squared_distances(A: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Factors (..., P, 4) and (..., 4, Q) of the squared distances between points x (..., P, 2) and points
    y (..., Q, 2) moved by similarity transforms A (..., 2, 3).

    ``|x − sRy − t|² = |x − t|² − 2 (sR)ᵀ(x − t) · y + s² |y|²``.
    """
    linear, moved = A[..., :2], x - A[..., None, :, 2]
    squared_scale = 0.5 * linear.square().sum(dim=(-2, -1))
    left = [-2.0 * (moved @ linear), squared_scale[..., None, None].expand_as(x[..., :1])]
    left.append(moved.square().sum(dim=-1, keepdim=True))
    right = [y, y.square().sum(dim=-1, keepdim=True), torch.ones_like(y[..., :1])]
    return torch.cat(left, dim=-1), torch.cat(right, dim=-1).transpose(-1, -2)

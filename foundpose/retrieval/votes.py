"""Retrieval by direct matching of patches: every patch of the crop is compared with every patch of all templates."""

from collections.abc import Callable

import torch
from torch import Tensor

from foundpose.representation import ObjectRepresentation
from foundpose.retrieval.base import (
    QueryPatches,
    RetrievedTemplates,
    Retriever,
    normalize_rows,
    select_templates,
)

_TEMPLATES_PER_BLOCK = 16


class PatchVoteRetriever(Retriever):
    """Retrieves templates by the mean, over the crop's patches, of the best cosine similarity to their patches.

    Exact: no words stand in for the patches. The price is a product of all patches of the crop with all patches of
    the object, 2 · 300 · 240k · 256 operations in the paper's setting.

    Args:
        num_templates: number h of templates per crop.
        chunk: similarities that exist at a time, which bounds the memory; the default takes 64 MiB in float32. Never
            fewer than those of one patch with 16 templates.

    Source: paper, Section 3.2, for what the bag of words takes the place of.
    """

    def __init__(self, num_templates: int = 5, chunk: int = 1 << 24) -> None:
        super().__init__(num_templates)
        if chunk < 1:
            raise ValueError(f"chunk must be at least 1, got {chunk}")
        self.chunk = chunk

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: patches of B crops.
            index: patches of the object's templates, in any precision; computed with in that of the query.

        Returns:
            The h most similar templates of each crop; a crop without valid patches has none, and templates without
            patches are never retrieved.

        Raises:
            ValueError: If the shapes of query and index do not fit.

        Differentiable w.r.t. ``query.descriptors`` and ``index.descriptors`` (unless they are codes) through
        ``similarity``; the choice of templates is constant, and so is which patches are most similar.
        """
        _check(query, index)
        x = query.descriptors.masked_fill(~query.valid.unsqueeze(-1), 0.0)
        read = index.read_descriptors
        similarity = template_similarities(
            x.detach(),
            query.valid,
            lambda rows: read(rows).detach(),
            index.template_offsets,
            self.chunk,
        )
        found = select_templates(similarity, query.valid.any(dim=1), self.num_templates)
        if torch.is_grad_enabled() and (x.requires_grad or index.descriptors.requires_grad):
            # Only what is returned needs a derivative, so only that is computed again with a graph.
            again = _similarity_of(found.index, x, query.valid, index)
            # Its value is the same but for rounding; only its derivative is wanted.
            found = found._replace(
                similarity=found.similarity + (again - again.detach()).masked_fill(~found.valid, 0.0)
            )
        return found

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"num_templates={self.num_templates}, chunk={self.chunk}"


def template_similarities(
    descriptors: Tensor,
    valid: Tensor,
    template_descriptors: Tensor | Callable[[Tensor], Tensor],
    template_offsets: Tensor,
    chunk: int,
) -> Tensor:
    """Mean best cosine similarity of each crop's valid patches to the patches of each template.

    Args:
        descriptors: (B, P, d) of the crops, finite.
        valid: (B, P) bool.
        template_descriptors: (M, d) of all templates, one template after another; or what returns rows of them, as
            codes are decoded block by block.
        template_offsets: (T + 1,) int64; template t owns patches ``offsets[t]`` to ``offsets[t + 1]``.
        chunk: number of similarities that exist at a time.

    Returns:
        (B, T); −inf for templates without patches, 0 for crops without.
    """
    rows = torch.nonzero(valid.flatten()).squeeze(1)
    x = normalize_rows(descriptors.flatten(0, 1)[rows])
    count = template_offsets.diff()
    read = (
        template_descriptors.__getitem__ if isinstance(template_descriptors, Tensor) else template_descriptors
    )
    # Templates of about the same size stand together, so that padding them to the largest costs little.
    order = count.argsort(stable=True)
    best = x.new_full((len(x), len(count)), -torch.inf)
    sizes = count[order].tolist()
    for first in range(0, len(sizes), _TEMPLATES_PER_BLOCK):
        block = order[first : first + _TEMPLATES_PER_BLOCK]
        most = sizes[min(first + _TEMPLATES_PER_BLOCK, len(sizes)) - 1]
        if most == 0:
            continue
        patches = _patches_of(block, most, read, template_offsets, x.dtype)
        flat = patches.flatten(0, 1).T
        step = max(1, chunk // flat.shape[1])
        for start in range(0, len(x), step):
            similarity = (x[start : start + step] @ flat).unflatten(1, (len(block), most))
            best[start : start + step, block] = similarity.amax(dim=2)
    empty = count == 0
    total = x.new_zeros(valid.numel(), len(count))
    total[rows] = best.masked_fill(empty, 0.0)
    mean = total.unflatten(0, valid.shape).sum(dim=1) / valid.sum(dim=1, keepdim=True).clamp(min=1)
    return mean.masked_fill(empty, -torch.inf)


def _similarity_of(templates: Tensor, x: Tensor, valid: Tensor, index: ObjectRepresentation) -> Tensor:
    """Similarities (B, h) of crops (B, P, d) to a few templates (B, h) of each, with a graph."""
    patches = _patches_of(
        templates, index.max_patches, index.read_descriptors, index.template_offsets, x.dtype
    )
    best = torch.einsum("bpd,bhqd->bhpq", normalize_rows(x), patches).amax(dim=3)
    return (best * valid.unsqueeze(1)).sum(dim=2) / valid.sum(dim=1, keepdim=True).clamp(min=1)


def _patches_of(
    templates: Tensor, most: int, read: Callable[[Tensor], Tensor], offsets: Tensor, dtype: torch.dtype
) -> Tensor:
    """Normalised patches (..., most, d) of templates (...); the last of a template repeats, which no maximum sees.

    What is returned for a template without patches is another one's.
    """
    start, count = offsets[templates], offsets.diff()[templates]
    position = torch.arange(most, device=offsets.device)
    rows = start.unsqueeze(-1) + torch.minimum(position, (count - 1).clamp(min=0).unsqueeze(-1))
    return normalize_rows(read(torch.minimum(rows, offsets[-1] - 1)).to(dtype))


def _check(query: QueryPatches, index: ObjectRepresentation) -> None:
    if query.descriptors.ndim != 3 or query.valid.shape != query.descriptors.shape[:2]:
        raise ValueError(
            "query.descriptors and query.valid must have shapes (B, P, d) and (B, P), got "
            f"{tuple(query.descriptors.shape)} and {tuple(query.valid.shape)}"
        )
    width = query.descriptors.shape[2]
    # Codes have a length of their own; words are as long as what they decode to.
    stored = index.descriptors if index.descriptors.is_floating_point() else index.words
    if stored.ndim != 2 or stored.shape[1] != width:
        raise ValueError(f"the object's descriptors must have shape (M, {width}), got {tuple(stored.shape)}")

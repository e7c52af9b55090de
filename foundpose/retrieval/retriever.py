"""Retrieval of the templates that look most like a crop."""

import torch
from torch import Tensor, nn

from foundpose.retrieval.base import QueryPatches, RetrievedTemplates, TemplateIndex
from foundpose.retrieval.bow import SoftAssignBow


def normalize_rows(x: Tensor) -> Tensor:
    """Scale the rows of (..., k) to unit length; zero rows stay zero.

    Differentiable w.r.t. ``x``; a zero row, which has no direction, has gradient zero.
    """
    norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return x / norm.where(norm > 0, torch.inf)


def select_templates(similarity: Tensor, valid: Tensor, num_templates: int) -> RetrievedTemplates:
    """Keep the most similar templates; of equal ones, those with lower indices.

    Args:
        similarity: (B, T) similarity of each crop to each template.
        valid: (B,) bool, False for crops of which nothing is known.
        num_templates: number h of templates to keep.

    Returns:
        (B, h) templates, best first; padded with index 0 where h > T.

    Differentiable w.r.t. ``similarity`` through the similarities kept; the choice of templates is constant.
    """
    kept = min(num_templates, similarity.shape[1])
    # topk leaves the order of equal values open, a stable sort does not.
    order = similarity.detach().sort(dim=1, descending=True, stable=True).indices[:, :kept]
    ok = valid.unsqueeze(1).expand_as(order)
    best = similarity.gather(1, order).masked_fill(~ok, -torch.inf)
    order = order.masked_fill(~ok, 0)
    padding = (0, num_templates - kept)
    return RetrievedTemplates(
        index=nn.functional.pad(order, padding),
        similarity=nn.functional.pad(best, padding, value=-torch.inf),
        valid=nn.functional.pad(ok, padding, value=False),
    )


class TemplateRetriever(nn.Module):
    """Retrieves templates by the cosine similarity of bag-of-words descriptors.

    Other retrievers take its place by having the same ``forward``.

    Args:
        bow: the descriptor; use the one that made the templates' descriptors.
        num_templates: number h of templates per crop.

    Source: paper, "Retrieving similar templates".
    """

    def __init__(self, bow: SoftAssignBow, num_templates: int = 5) -> None:
        super().__init__()
        if num_templates < 1:
            raise ValueError(f"num_templates must be at least 1, got {num_templates}")
        self.bow = bow
        self.num_templates = num_templates

    def forward(self, query: QueryPatches, index: TemplateIndex) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: patches of B crops.
            index: words, idf and templates of the object.

        Returns:
            The h most similar templates of each crop; a crop without valid patches has none.

        Raises:
            ValueError: If the shapes of query and index do not fit.

        Differentiable w.r.t. ``query.descriptors``, ``index.words``, ``index.idf`` and ``index.template_bow``
        through ``similarity``; the choice of templates is constant, and so is the choice of nearest words.
        ``template_bow`` is taken as given: it does not follow words and idf.
        """
        if index.template_bow.ndim != 2 or index.template_bow.shape[1] != index.words.shape[0]:
            raise ValueError(
                f"template_bow must have shape (T, {index.words.shape[0]}), got {tuple(index.template_bow.shape)}"
            )
        vectors = self.bow(query.descriptors, query.valid, index.words, index.idf)
        similarity = normalize_rows(vectors) @ index.template_bow.T
        return select_templates(similarity, query.valid.any(dim=1), self.num_templates)

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"num_templates={self.num_templates}"

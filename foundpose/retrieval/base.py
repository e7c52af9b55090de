"""What retrieval receives and returns, and the contract of retrievers."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.representation import ObjectRepresentation


class QueryPatches(NamedTuple):
    """Patches of a batch of crops, padded.

    Attributes:
        descriptors: (B, P, d) projected descriptors; rows that are not valid are finite but mean nothing.
        pixels: (B, P, 2) patch centres in the crop, pixels.
        valid: (B, P) bool, patch centre inside the crop's mask.
        cls: (B, C) raw global descriptors, or None.
    """

    descriptors: Tensor
    pixels: Tensor
    valid: Tensor
    cls: Tensor | None = None


class RetrievedTemplates(NamedTuple):
    """Templates that look most like each crop, best first.

    Attributes:
        index: (B, h) template indices, int64.
        similarity: (B, h) similarities; −inf where fewer than h templates exist or the crop has no patches.
        valid: (B, h) bool.
    """

    index: Tensor  # type: ignore[assignment]  # hides tuple.index
    similarity: Tensor
    valid: Tensor


class Retriever(nn.Module, ABC):
    """Finds the templates of an object that look most like a crop.

    A crop's answer does not depend on the other crops of the batch. Whatever has the same ``forward`` can take a
    retriever's place in :class:`foundpose.FoundPose`; a subclass can also say what it relies on.

    Args:
        num_templates: number h of templates per crop.
    """

    def __init__(self, num_templates: int = 5) -> None:
        super().__init__()
        if num_templates < 1:
            raise ValueError(f"num_templates must be at least 1, got {num_templates}")
        self.num_templates = num_templates

    @abstractmethod
    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: patches of B crops.
            index: the object.

        Returns:
            The h most similar templates of each crop; a crop without valid patches has none.
        """

    def onboarding_settings(self) -> dict[str, str]:
        """Settings that objects should have been onboarded with, by their names in ``Onboarder.settings``."""
        return {}

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"num_templates={self.num_templates}"


def normalize_rows(x: Tensor) -> Tensor:
    """Scale the rows of (..., k) to unit length; zero rows stay zero.

    Differentiable w.r.t. ``x``; a zero row, which has no direction, has gradient zero.
    """
    norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return x / norm.where(norm > 0, torch.inf)


def spread_patches(query: QueryPatches, most: int | None) -> QueryPatches:
    """At most so many of each crop's valid patches, in an order whose every beginning is evenly spread."""
    available = query.valid.shape[1]
    most = available if most is None else min(most, available)
    place = torch.arange(most, device=query.valid.device)
    # Multiples of the golden ratio's inverse leave no gaps, however many are taken.
    place = (place * 0.6180339887498949).remainder(1.0).argsort()
    count = query.valid.sum(dim=1, keepdim=True)
    number = count.clamp(max=most)
    chosen = ((place * count) // number.clamp(min=1)).clamp(max=available - 1)
    return query._replace(
        descriptors=torch.take_along_dim(query.descriptors, chosen.unsqueeze(-1), dim=1),
        pixels=torch.take_along_dim(query.pixels, chosen.unsqueeze(-1), dim=1),
        valid=place < number,
    )


def select_templates(similarity: Tensor, valid: Tensor, num_templates: int) -> RetrievedTemplates:
    """Keep the most similar templates; of equal ones, those with lower indices.

    Args:
        similarity: (B, T) similarity of each crop to each template; −inf for templates never to be kept.
        valid: (B,) bool, False for crops of which nothing is known.
        num_templates: number h of templates to keep.

    Returns:
        (B, h) templates, best first; padded with index 0 where fewer than h can be kept.

    Differentiable w.r.t. ``similarity`` through the similarities kept; the choice of templates is constant.
    """
    kept = min(num_templates, similarity.shape[1])
    # topk leaves the order of equal values open, a stable sort does not.
    order = similarity.detach().sort(dim=1, descending=True, stable=True).indices[:, :kept]
    best = similarity.gather(1, order)
    ok = valid.unsqueeze(1) & (best > -torch.inf)
    best = best.masked_fill(~ok, -torch.inf)
    order = order.masked_fill(~ok, 0)
    padding = (0, num_templates - kept)
    return RetrievedTemplates(
        index=nn.functional.pad(order, padding),
        similarity=nn.functional.pad(best, padding, value=-torch.inf),
        valid=nn.functional.pad(ok, padding, value=False),
    )

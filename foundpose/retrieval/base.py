"""What retrieval receives and returns."""

from typing import NamedTuple, Protocol

from torch import Tensor


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


class TemplateIndex(Protocol):
    """What a retriever reads of an object representation (all buffers on one device).

    Attributes:
        words: (k, d) visual words.
        idf: (k,) inverse document frequencies, ``log(N / n_i)``.
        template_bow: (T, k) bag-of-words descriptors of the templates, L2-normalised.
    """

    words: Tensor
    idf: Tensor
    template_bow: Tensor


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

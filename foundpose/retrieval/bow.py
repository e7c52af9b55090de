"""Bag-of-words descriptors: soft assignment of patches to visual words, and tf-idf.

A ragged set of patches is a padded (B, P, d) tensor with a (B, P) mask; rows outside the mask count nothing.
"""

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from foundpose.utils.settings import Configured, Setting

IdfMode = Literal["document", "occurrence"]
BowNormalization = Literal["cosine", "hellinger"]

AUTO_SIGMA = 0.4
"""σ as a share of the patches' median distance from their nearest words, where it is to be measured."""

# Distances to all words exist for one block of patches at a time: 8 M entries, 32 MiB in float32.
_DISTANCES_PER_BLOCK = 1 << 23
_GROUP = 64


class WordAssignment(NamedTuple):
    """Nearest visual words of patches.

    Attributes:
        word: (B, P, m) words, nearest first, int64.
        weight: (B, P, m) weights that sum to 1 over m for valid patches and are 0 for others.
    """

    word: Tensor
    weight: Tensor


def nearest_words(descriptors: Tensor, words: Tensor, num_nearest: int) -> tuple[Tensor, Tensor]:
    """Nearest words of descriptors.

    Args:
        descriptors: (n, d).
        words: (k, d).
        num_nearest: number m of words, at most k.

    Returns:
        Squared Euclidean distances (n, m), ascending, and word indices (n, m). The distances are computed from
        differences, so they are accurate near zero.

    Differentiable w.r.t. ``descriptors`` and ``words`` (the choice of words is constant).
    """
    # The choice has no derivative; |x|² is the same for all words.
    fixed, fixed_words = descriptors.detach(), words.detach()
    squared_norms = fixed_words.square().sum(dim=1)
    index = torch.empty(descriptors.shape[0], num_nearest, dtype=torch.int64, device=descriptors.device)
    rows = max(1, _DISTANCES_PER_BLOCK // words.shape[0])
    for start in range(0, descriptors.shape[0], rows):
        block = slice(start, start + rows)
        score = torch.addmm(squared_norms, fixed[block], fixed_words.T, alpha=-2.0)
        index[block] = _smallest(score, num_nearest)
    rows = max(1, _DISTANCES_PER_BLOCK // (num_nearest * words.shape[1]))
    pairs = zip(descriptors.split(rows), index.split(rows), strict=True)
    # Whole rows are selected: several times as fast on a CPU as indexing by a tensor.
    nearest = ((x, words.index_select(0, i.flatten()).unflatten(0, i.shape)) for x, i in pairs)
    distance = torch.cat([(x.unsqueeze(1) - near).square().sum(dim=-1) for x, near in nearest])
    # The products above are too coarse to tell words apart that are nearly as far.
    distance, order = distance.sort(dim=1, stable=True)
    return distance, index.gather(1, order)


def _smallest(scores: Tensor, count: int) -> Tensor:
    """Indices (n, count) of the smallest of scores (n, k), in no particular order.

    They lie in the groups with the smallest minima: a search in two steps, of which the first is vectorised, takes a
    third of the time of ``topk``.
    """
    groups = scores.shape[1] // _GROUP
    if scores.shape[1] % _GROUP or groups < 2 * count:
        return scores.topk(count, dim=1, largest=False).indices
    grouped = scores.unflatten(1, (groups, _GROUP))
    near = grouped.amin(dim=2).topk(count, dim=1, largest=False).indices
    few = grouped.gather(1, near.unsqueeze(2).expand(-1, -1, _GROUP)).flatten(1)
    place = few.topk(count, dim=1, largest=False).indices
    return near.gather(1, place // _GROUP) * _GROUP + place % _GROUP


def assign_words(
    descriptors: Tensor, valid: Tensor, words: Tensor, sigma: float, num_nearest: int
) -> WordAssignment:
    """Soft-assign patches to their nearest words with weights ∝ exp(−d² / 2σ²).

    Weights are normalised over the nearest words of a patch in log space: a patch far from all words still has
    weights that sum to 1.

    Args:
        descriptors: (B, P, d) descriptors.
        valid: (B, P) bool.
        words: (k, d) visual words.
        sigma: σ, in the unit of the descriptors.
        num_nearest: number of words per patch (all k if there are fewer).

    Returns:
        Words and weights of each patch.

    Differentiable w.r.t. ``descriptors`` and ``words`` through the weights; the choice of words is constant.
    """
    # Padding may hold anything; zeros keep it out of the gradient as well.
    flat = descriptors.masked_fill(~valid.unsqueeze(-1), 0.0).flatten(0, 1)
    distance, index = nearest_words(flat, words, min(num_nearest, words.shape[0]))
    # Relative to the nearest word, and divided twice: a tiny σ gives −inf, never 0 · inf.
    log_weight = (distance - distance[:, :1].detach()) / sigma / sigma * -0.5
    weight = torch.softmax(log_weight, dim=-1)
    weight = weight.unflatten(0, valid.shape) * valid.unsqueeze(-1)
    return WordAssignment(index.unflatten(0, valid.shape), weight)


def word_counts(assignment: WordAssignment, num_words: int) -> Tensor:
    """Soft number of occurrences of each word in each crop.

    Args:
        assignment: words and weights of (B, P) patches.
        num_words: number k of words.

    Returns:
        (B, k) counts; a row sums to the number of valid patches. Differentiable w.r.t. the weights.
    """
    index, weight = assignment.word.flatten(1), assignment.weight.flatten(1)
    return weight.new_zeros(weight.shape[0], num_words).scatter_add(1, index, weight)


def inverse_document_frequency(
    assignment: WordAssignment, valid: Tensor, num_words: int, mode: IdfMode = "document"
) -> Tensor:
    """Inverse document frequencies log(N / n_i) of words over N templates.

    Args:
        assignment: words and weights of the templates' patches, (N, P, m).
        valid: (N, P) bool.
        num_words: number k of words.
        mode: "document": n_i is the number of templates with a patch that has the word among its nearest ones,
            so the result is never negative (the classical tf-idf). "occurrence": n_i is the soft number of
            occurrences in all templates (the paper's wording); negative for words that occur more than N times.

    Returns:
        (k,) frequencies in the dtype of the weights; 0 for a word that never occurs.

    Differentiable w.r.t. the weights in mode "occurrence" only.
    """
    if mode == "document":
        weight = valid.unsqueeze(-1).expand_as(assignment.word).to(assignment.weight.dtype)
        occurs = word_counts(WordAssignment(assignment.word, weight), num_words) > 0
        count = occurs.sum(dim=0).to(assignment.weight.dtype)
    elif mode == "occurrence":
        count = word_counts(assignment, num_words).sum(dim=0)
    else:
        raise ValueError(f"mode must be 'document' or 'occurrence', got {mode!r}")
    present = count > 0
    return torch.where(present, torch.log(valid.shape[0] / count.where(present, torch.ones_like(count))), 0.0)


def tf_idf(counts: Tensor, idf: Tensor) -> Tensor:
    """Weighted word frequencies b_i = (n_it / n_t) idf_i.

    Args:
        counts: (B, k) occurrences n_it; n_t is their sum (each patch counts 1).
        idf: (k,) inverse document frequencies.

    Returns:
        (B, k), zeros for a row without occurrences. Differentiable w.r.t. both arguments.
    """
    total = counts.sum(dim=1, keepdim=True)
    return counts / total.where(total > 0, torch.ones_like(total)) * idf


def signed_root(x: Tensor) -> Tensor:
    """sign(x) √|x|, element by element, as Hellinger's kernel wants it.

    Differentiable w.r.t. ``x``; at zero, where the root's slope is infinite, the gradient is zero.
    """
    present = x != 0
    root = x.abs().where(present, torch.ones_like(x)).sqrt()
    return torch.where(present, root * x.sign(), torch.zeros_like(x))


class SoftAssignBow(Configured):
    """Bag-of-words descriptors with soft assignment; templates and queries alike go through it.

    Args:
        sigma: σ of the soft assignment in the unit of the descriptors (the paper's 10 for DINOv2), or "auto": 0.4
            of the median distance of the templates' patches from their nearest words, which onboarding measures.
        num_nearest: number of words to which a patch contributes.
        normalization: what is done to weighted word frequencies before they are compared by their cosine. "cosine":
            nothing (the paper). "hellinger": (signed) square roots are taken, so that a few frequent words do not
            outweigh all others.

    Source: paper, "Bag-of-words descriptors"; Philbin et al., CVPR 2008; Hellinger: Arandjelović and Zisserman,
        "Three
    things everyone should know to improve object retrieval", CVPR 2012.
    """

    def __init__(
        self,
        sigma: float | Literal["auto"] = 10.0,
        num_nearest: int = 3,
        normalization: BowNormalization = "hellinger",
    ) -> None:
        super().__init__()
        if isinstance(sigma, str) and sigma != "auto":
            raise ValueError(f"sigma must be a number or 'auto', got {sigma!r}")
        if not isinstance(sigma, str) and not sigma > 0:
            raise ValueError(f"sigma must be positive, got {sigma}")
        if num_nearest < 1:
            raise ValueError(f"num_nearest must be at least 1, got {num_nearest}")
        if normalization not in get_args(BowNormalization):
            raise ValueError(
                f"normalization must be one of {get_args(BowNormalization)}, got {normalization!r}"
            )
        self.sigma: float | Literal["auto"] = sigma
        self.num_nearest = num_nearest
        self.normalization: BowNormalization = normalization

    def assign(
        self, descriptors: Tensor, valid: Tensor, words: Tensor, word_distance: float | None = None
    ) -> WordAssignment:
        """Soft-assign patches (B, P, d) with mask (B, P) to words (k, d); see `assign_words`.

        ``word_distance`` is what an automatic σ is measured by.

        Differentiable w.r.t. ``descriptors`` and ``words`` through the weights; the choice of words is constant.
        """
        if descriptors.ndim != 3 or valid.shape != descriptors.shape[:2] or valid.dtype != torch.bool:
            raise ValueError(
                "descriptors and valid must have shapes (B, P, d) and (B, P) bool, got "
                f"{tuple(descriptors.shape)} and {tuple(valid.shape)} {valid.dtype}"
            )
        if words.ndim != 2 or words.shape[1] != descriptors.shape[2] or words.shape[0] < 1:
            raise ValueError(f"words must have shape (k, {descriptors.shape[2]}), got {tuple(words.shape)}")
        return assign_words(descriptors, valid, words, self._sigma(word_distance), self.num_nearest)

    def _sigma(self, word_distance: float | None) -> float:
        if self.sigma != "auto":
            return self.sigma
        if word_distance is None:
            raise ValueError("sigma is auto: give word_distance, or set sigma to a number")
        return AUTO_SIGMA * word_distance

    def forward(
        self,
        descriptors: Tensor,
        valid: Tensor,
        words: Tensor,
        idf: Tensor,
        word_distance: float | None = None,
    ) -> Tensor:
        """Describe crops by weighted word frequencies.

        Args:
            descriptors: (B, P, d) projected descriptors.
            valid: (B, P) bool.
            words: (k, d) visual words.
            idf: (k,) inverse document frequencies.
            word_distance: median distance of the templates' patches from their nearest words; for an automatic σ.

        Returns:
            (B, k), of any length; zeros for a crop without valid patches.

        Raises:
            ValueError: If shapes do not fit.

        Differentiable w.r.t. ``descriptors``, ``words`` and ``idf``; which words are nearest is constant.
        """
        assignment = self.assign(descriptors, valid, words, word_distance)
        if idf.shape != words.shape[:1]:
            raise ValueError(f"idf must have shape ({words.shape[0]},), got {tuple(idf.shape)}")
        return self.weigh(word_counts(assignment, words.shape[0]), idf)

    def weigh(self, counts: Tensor, idf: Tensor) -> Tensor:
        """Bags (B, k) from soft numbers of occurrences (B, k) and inverse document frequencies (k,).

        Differentiable w.r.t. both arguments.
        """
        frequencies = tf_idf(counts, idf)
        return signed_root(frequencies) if self.normalization == "hellinger" else frequencies

    def settings(self) -> dict[str, Setting]:
        """Settings by name."""
        return {"sigma": self.sigma, "num_nearest": self.num_nearest, "normalization": self.normalization}

"""Which estimates of a target count, and which annotation each of them is matched to (rules of BOP'19).

A target is an object in an image with ``inst_count`` instances to localise. Targets are handled as one batch, padded
to the largest number of estimates and annotations.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Ranking(NamedTuple):
    """The best entries of N padded lists.

    Attributes:
        order: (N, n) int64, indices of the entries, best first; equal ones in the order given, padding last.
        counted: (N, n) bool, the entry at this place of ``order`` is among the ``count`` best.
    """

    order: Tensor
    counted: Tensor


def best_first(values: Tensor, exists: Tensor, count: Tensor) -> Ranking:
    """Sort padded lists and mark the best entries of each: the estimates of a target that are evaluated.

    Args:
        values: (N, n), the higher the better; NaN is worse than any number.
        exists: (N, n) bool, which entries are no padding.
        count: (N,) integers, how many to mark in each list.

    Returns:
        The ranking.

    Raises:
        ValueError: wrong shapes.

    Differentiable w.r.t. nothing.
    """
    if values.dim() != 2 or exists.shape != values.shape or count.shape != values.shape[:1]:
        raise ValueError(
            "values and exists must have shape (N, n) and count (N,), got "
            f"{tuple(values.shape)}, {tuple(exists.shape)} and {tuple(count.shape)}"
        )
    worst = torch.where(values.isnan(), -torch.inf, values.detach())
    order = worst.sort(dim=1, descending=True, stable=True).indices
    # A second stable sort, so that padding comes even after an entry of value -inf.
    last = (~exists).gather(1, order).byte().sort(dim=1, stable=True).indices
    order = order.gather(1, last)
    place = torch.arange(values.shape[1], device=values.device)
    return Ranking(order, exists.gather(1, order) & (place < count[:, None]))


def most_visible(visibility: Tensor, exists: Tensor, count: Tensor) -> Tensor:
    """Annotations that are to be found: the ``count`` most visible of each target, equal ones in the order given.

    Args:
        visibility: (N, g) visible share of each annotated instance.
        exists: (N, g) bool, which entries are no padding.
        count: (N,) integers, instances of the target.

    Returns:
        (N, g) bool, in the order given.

    Raises:
        ValueError: wrong shapes.
    """
    ranking = best_first(visibility, exists, count)
    return torch.zeros_like(ranking.counted).scatter(1, ranking.order, ranking.counted)


def greedy_matches(errors: Tensor, thresholds: Tensor, valid: Tensor | None = None) -> Tensor:
    """Match estimates to annotations as BOP'19 does, for every threshold on its own.

    In the order given, each estimate takes the valid annotation of smallest error (the first of equal ones) among
    those that are still free, if that error is strictly below the threshold; otherwise it takes none.

    Args:
        errors: (..., n, g) of n estimates, best score first, against g annotations. An error that is NaN or
            infinite never matches.
        thresholds: (T,) in the unit of ``errors``.
        valid: bool, broadcastable to ``errors``: which pairs may match (no padding; the annotation is to be found;
            the estimate is counted). All by default.

    Returns:
        (..., T, g) int64: the place of the estimate that each annotation is matched to, −1 for none.

    Raises:
        ValueError: wrong shapes.

    Differentiable w.r.t. nothing.
    Source: Hodaň et al., "BOP Challenge 2020", section 2.3.
    """
    if errors.dim() < 2 or not errors.is_floating_point() or thresholds.dim() != 1:
        raise ValueError(
            "errors must be floating with shape (..., n, g) and thresholds (T,), got "
            f"{errors.dtype} {tuple(errors.shape)} and {tuple(thresholds.shape)}"
        )
    usable = errors.isfinite() if valid is None else errors.isfinite() & valid
    errors = torch.where(usable, errors.detach(), torch.inf)
    thresholds = thresholds.to(errors)
    *batch, n, g = errors.shape
    matched = torch.full((*batch, len(thresholds), g), -1, dtype=torch.int64, device=errors.device)
    if g == 0:
        return matched
    for place in range(n):
        free = torch.where(matched < 0, errors[..., place, None, :], torch.inf)
        smallest, annotation = free.min(dim=-1)  # the first of equal ones
        index = annotation[..., None]
        taken = torch.where((smallest < thresholds)[..., None], place, matched.gather(-1, index))
        matched = matched.scatter(-1, index, taken)
    return matched

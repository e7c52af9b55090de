"""Which estimates of a target count, and which annotation each of them is matched to (rules of BOP'19).

A target is an object in an image with ``inst_count`` instances to localise.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def best(values: Sequence[float], count: int | None) -> list[int]:
    """Indices of the ``count`` highest values (None: all), best first; equal ones in the order given, NaN last."""
    return sorted(range(len(values)), key=lambda i: math.inf if math.isnan(values[i]) else -values[i])[:count]


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

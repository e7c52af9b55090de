"""Masks as sets of pixels."""

import torch.nn.functional as F
from torch import Tensor


def grow_masks(masks: Tensor, radius: int) -> Tensor:
    """Grow masks by a square of ``2 * radius + 1`` pixels, or shrink them by one where ``radius`` is negative.

    Args:
        masks: (..., H, W) bool.
        radius: pixels. What lies beyond the border counts as outside when a mask grows, as inside when it shrinks.

    Returns:
        Masks of the same shape.
    """
    if radius < 0:
        return ~grow_masks(~masks, -radius)
    grown, width = F.pad(masks, 4 * (radius,)), 2 * radius + 1
    # Bits of pixels that lie ever farther apart, up to the square's width.
    for dim in (-2, -1):
        reach = 1
        while reach < width:
            step = min(reach, width - reach)
            length = grown.shape[dim] - step
            grown = grown.narrow(dim, 0, length) | grown.narrow(dim, step, length)
            reach += step
    return grown

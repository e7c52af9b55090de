"""2D boxes as ``(left, top, right, bottom)`` pixel edges: the box of the single pixel (u, v) is
``(u - 0.5, v - 0.5, u + 0.5, v + 0.5)``.
"""

import torch
from torch import Tensor

from foundpose.utils.devices import constant


def boxes_from_masks(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Tight boxes around masks.

    Args:
        masks: (B, H, W), bool or numeric; non-zero is inside.

    Returns:
        Boxes (B, 4) float32 as pixel edges and a flag (B,) that is False for an empty mask, whose box is the
        whole image. Not differentiable: boxes jump from pixel to pixel.
    """
    if masks.dim() != 3:
        raise ValueError(f"masks must have shape (B, H, W), got {tuple(masks.shape)}")
    inside = masks != 0
    columns, rows = inside.any(dim=1), inside.any(dim=2)
    valid = columns.any(dim=1)
    low_u, high_u = _first_and_last(columns)
    low_v, high_v = _first_and_last(rows)
    boxes = torch.stack([low_u - 0.5, low_v - 0.5, high_u + 0.5, high_v + 0.5], dim=-1)
    height, width = masks.shape[1:]
    whole = constant([-0.5, -0.5, width - 0.5, height - 0.5], boxes)
    return torch.where(valid[:, None], boxes, whole), valid


def _first_and_last(occupied: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the first and the last True of each row of (B, L), as float32."""
    length = occupied.shape[1]
    first = occupied.to(torch.uint8).argmax(dim=1)
    last = length - 1 - occupied.flip(1).to(torch.uint8).argmax(dim=1)
    return first.float(), last.float()


def boxes_from_points(pixels: Tensor) -> Tensor:
    """Boxes (..., 4) spanned by points (..., N, 2). Differentiable w.r.t. the extreme points."""
    return torch.cat([pixels.amin(dim=-2), pixels.amax(dim=-2)], dim=-1)


def boxes_from_xywh(xywh: Tensor) -> Tensor:
    """Boxes of pixels ``[x, y, width, height]`` (first column, first row, number of columns and rows) as edges.

    Differentiable w.r.t. ``xywh``.
    """
    x, y, w, h = xywh.unbind(-1)
    return torch.stack([x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5], dim=-1)


def masks_from_boxes(boxes: Tensor, height: int, width: int) -> Tensor:
    """Masks (B, H, W) bool of the pixels whose centres lie in the boxes (B, 4). Not differentiable."""
    u = torch.arange(width, device=boxes.device, dtype=boxes.dtype)
    v = torch.arange(height, device=boxes.device, dtype=boxes.dtype)
    inside_u = (u >= boxes[:, 0, None]) & (u <= boxes[:, 2, None])
    inside_v = (v >= boxes[:, 1, None]) & (v <= boxes[:, 3, None])
    return inside_v[:, :, None] & inside_u[:, None, :]

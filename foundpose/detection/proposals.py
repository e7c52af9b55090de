"""What may be an object: masks of pictures, and the contract of what finds them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.detection.dense import DescriptorMap
from foundpose.geometry import masks_from_boxes

# Overlaps are measured on so many pixels of a mask at most.
_MOST_PIXELS = 1 << 15


class Pictures(NamedTuple):
    """Pictures in which objects are looked for.

    Attributes:
        images: (N, 3, H, W) RGB in [0, 1].
        K: (N, 3, 3) intrinsics, pixels.
        descriptors: of all patches of the pictures, at one scale or several; None where no stage of a detector asks
            for them.
        names: of the pictures, such as BOP's (scene, image), for proposals that are kept by name.
    """

    images: Tensor
    K: Tensor
    descriptors: Sequence[DescriptorMap] | None = None
    names: Sequence[object] | None = None


class Proposals(NamedTuple):
    """Regions of N pictures, padded to the most of any picture.

    Attributes:
        masks: (N, P, H, W) bool.
        score: (N, P) in [0, 1], how sure the proposer is that it is one object; 1 where it does not say.
        valid: (N, P) bool.
    """

    masks: Tensor
    score: Tensor
    valid: Tensor


class Proposer(nn.Module, ABC):
    """Finds regions that may be objects.

    Attributes:
        needs_descriptors: whether :class:`Pictures` must hold descriptors.
    """

    needs_descriptors = False

    @abstractmethod
    def forward(self, pictures: Pictures) -> Proposals:
        """Regions of pictures; a picture may have none.

        Not differentiable (a choice).
        """


def pad_proposals(masks: Sequence[Tensor], scores: Sequence[Tensor] | None = None) -> Proposals:
    """Proposals of pictures that have different numbers of them.

    Args:
        masks: of each picture, (P_n, H, W) bool.
        scores: of each picture, (P_n,); 1 by default.
    """
    most = max((len(mask) for mask in masks), default=0)
    shape = (len(masks), most, *masks[0].shape[1:])
    padded = torch.zeros(shape, dtype=torch.bool, device=masks[0].device)
    score = torch.zeros(shape[:2], device=masks[0].device)
    valid = torch.zeros_like(score, dtype=torch.bool)
    for n, mask in enumerate(masks):
        padded[n, : len(mask)] = mask
        score[n, : len(mask)] = 1.0 if scores is None else scores[n]
        valid[n, : len(mask)] = mask.flatten(1).any(dim=1)
    return Proposals(padded, score, valid)


def proposals_from_boxes(
    boxes: Sequence[Tensor], height: int, width: int, scores: Sequence[Tensor] | None = None
) -> Proposals:
    """Proposals of boxes, such as any detector's.

    Args:
        boxes: of each picture, (P_n, 4) as ``(left, top, right, bottom)`` pixel edges.
        height: of the pictures.
        width: of the pictures.
        scores: of each picture, (P_n,) in [0, 1]; 1 by default.
    """
    return pad_proposals([masks_from_boxes(box, height, width) for box in boxes], scores)


def mask_overlaps(masks: Tensor) -> Tensor:
    """Intersection over union (P, P) of masks (P, H, W), of which large ones are looked at on every n-th pixel."""
    step = max(1, round((masks[0].numel() / _MOST_PIXELS) ** 0.5)) if len(masks) else 1
    inside = masks[:, ::step, ::step].flatten(1).float()
    both = inside @ inside.T
    size = both.diagonal()
    return both / (size[:, None] + size[None] - both).clamp_min(1.0)


def suppress(overlaps: Tensor, score: Tensor, most: float) -> Tensor:
    """Which of P regions remain when, from the best score down, those that overlap a remaining one by more go.

    Args:
        overlaps: (P, P).
        score: (P,).
        most: allowed overlap.

    Returns:
        Indices, best score first.
    """
    order = score.argsort(descending=True, stable=True)
    # Greedy, so one after another; on the host, where a step takes no launch.
    rivals = (overlaps[order][:, order] > most).cpu()
    left = torch.ones(len(order), dtype=torch.bool)
    for place in range(len(order)):
        if left[place]:
            left[place + 1 :] &= ~rivals[place, place + 1 :]
    return order[left.to(order.device)]

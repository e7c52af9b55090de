"""Perspective warps of images to square crops, with an image pyramid where they shrink.

kornia's ``remap`` samples, at positions that are found once for a picture, the levels of its pyramid and its mask.
The tests compare it with kornia's ``warp_perspective``.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from kornia.geometry.transform import remap
from torch import Tensor

from foundpose.utils.devices import indices_on


def warped_pixels(homographies: Tensor, size: int) -> Tensor:
    """Where the pixels of square crops lie in their images.

    Args:
        homographies: (B, 3, 3) from pixels of the image to pixels of the crop.
        size: side S of the crops.

    Returns:
        (B, 2, S, S) pixel coordinates (u, v) in the image. Differentiable w.r.t. ``homographies``.
    """
    M = torch.linalg.inv(homographies)
    axis = torch.arange(size, dtype=M.dtype, device=M.device)
    # A sum over columns and rows is all that a plane needs.
    across = (M[:, :, :1] * axis).unsqueeze(2)
    down = (M[:, :, 1:2] * axis + M[:, :, 2:]).unsqueeze(3)
    return (across[:, :2] + down[:, :2]) / (across[:, 2:] + down[:, 2:])


def sample_pixels(images: Tensor, positions: Tensor) -> Tensor:
    """Bilinear samples of images (B, C, H, W) at pixels (B, 2, h, w) as (u, v): (B, C, h, w); zero beyond the border.

    Differentiable w.r.t. both arguments.
    """
    u, v = positions.unbind(1)
    return remap(images, u, v, align_corners=True)


def warp_images(
    images: Tensor, homographies: Tensor, image_index: Tensor, levels: Tensor, size: int
) -> Tensor:
    """Warp images to square crops, sampling level ``levels`` of their pyramids.

    Args:
        images: (N, C, H, W).
        homographies: (B, 3, 3) from pixels of the image to pixels of the crop.
        image_index: (B,) which image to warp.
        levels: (B,) pyramid level, 0 is the image itself; in between, two levels are blended.
        size: side S of the crops.

    Returns:
        (B, C, S, S). Differentiable w.r.t. ``images``, ``homographies`` and ``levels``.
    """
    return sample_pyramids(images, warped_pixels(homographies, size), image_index.tolist(), levels)


def sample_pyramids(images: Tensor, positions: Tensor, image_index: Sequence[int], levels: Tensor) -> Tensor:
    """Sample images at positions, from level ``levels`` of their pyramids.

    Args:
        images: (N, C, H, W).
        positions: (B, 2, S, S) pixel coordinates (u, v) in the image.
        image_index: B numbers, which image to sample.
        levels: (B,) pyramid level, 0 is the image itself; in between, two levels are blended.

    Returns:
        (B, C, S, S), zero beyond the border. Differentiable w.r.t. ``images``, ``positions`` and ``levels``.
    """
    height, width = images.shape[-2:]
    top_level = int(math.log2(min(height, width))) - 1
    levels = levels.clamp(max=max(top_level, 0))
    # The one transfer to the host: which levels are needed.
    host_levels = levels.tolist()
    members: dict[tuple[int, int], list[int]] = {}
    for crop, (image, level) in enumerate(zip(image_index, host_levels, strict=True)):
        for whole in {math.floor(level), math.ceil(level)}:
            members.setdefault((image, whole), []).append(crop)
    pyramid = [images]
    for _ in range(max((level for _, level in members), default=0)):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2, ceil_mode=True, count_include_pad=False))
    parts = []
    for (image, level), crop_list in members.items():
        crops = indices_on(images.device, torch.tensor(crop_list))
        source = pyramid[level][image].expand(len(crop_list), -1, -1, -1)
        mine = positions if len(crop_list) == len(positions) else positions[crops]
        # A pixel of a level covers a square of the image's, whose centre is its own.
        sampled = sample_pixels(source, mine if level == 0 else (mine + 0.5) / 2.0**level - 0.5)
        if any(host_levels[crop] != level for crop in crop_list):
            sampled = sampled * (1.0 - (levels[crops] - level).abs())[:, None, None, None]
        parts.append((crop_list, crops, sampled))
    if [crop for crop_list, _, _ in parts for crop in crop_list] == list(range(len(positions))) and parts:
        # Each crop is of one level and they come in order: nothing to add up.
        return parts[0][2] if len(parts) == 1 else torch.cat([sampled for _, _, sampled in parts])
    out = images.new_zeros(len(positions), images.shape[1], *positions.shape[2:])
    for _, crops, sampled in parts:
        out = out.index_add(0, crops, sampled)
    return out

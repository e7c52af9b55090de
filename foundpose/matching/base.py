"""What matching returns, and the checks of what it receives."""

from typing import NamedTuple

import torch
from torch import Tensor


class Matches(NamedTuple):
    """Matches of the patches of B crops to the patches of h templates each.

    Attributes:
        template_patch: (B, h, P) index into the template's (padded) patches, int64; 0 where not valid.
        distance: (B, h, P) Euclidean distance of the descriptors; +inf where not valid.
        valid: (B, h, P) bool.
        points_model: (B, h, P, 3) 3D point that the crop's patch is matched to, mesh units; zero where not valid.
        weight: (B, h, P) confidence of the match in (0, 1]; 0 where not valid.
        priority: (B, h, P) order in which to trust matches, the larger the sooner; −inf where not valid. For RANSAC's
            samples; a constant.
    """

    template_patch: Tensor
    distance: Tensor
    valid: Tensor
    points_model: Tensor
    weight: Tensor
    priority: Tensor


def check_patches(
    query: Tensor,
    query_valid: Tensor,
    template: Tensor,
    template_valid: Tensor,
    pixels: Tensor,
    points: Tensor,
) -> None:
    """Raise ValueError unless the shapes are those of :meth:`PatchMatcher.forward`."""
    fits = query.ndim == 3 and template.ndim == 4
    if not (fits and template.shape[0] == query.shape[0] and template.shape[3] == query.shape[2]):
        raise ValueError(
            "descriptors must have shapes (B, P, d) for crops and (B, h, Q, d) for templates, got "
            f"{tuple(query.shape)} and {tuple(template.shape)}"
        )
    for name, mask, expected in (
        ("query_valid", query_valid, query.shape[:2]),
        ("template_valid", template_valid, template.shape[:3]),
    ):
        if mask.shape != expected or mask.dtype != torch.bool:
            raise ValueError(
                f"{name} must be bool of shape {tuple(expected)}, got {tuple(mask.shape)} {mask.dtype}"
            )
    if pixels.shape != (*query.shape[:2], 2):
        raise ValueError(f"query_pixels must have shape {(*query.shape[:2], 2)}, got {tuple(pixels.shape)}")
    if points.shape != (*template.shape[:3], 3):
        raise ValueError(
            f"template_points must have shape {(*template.shape[:3], 3)}, got {tuple(points.shape)}"
        )

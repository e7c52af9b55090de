"""Matching of crop patches to template patches by their descriptors."""

from typing import Literal

import torch
from torch import Tensor, nn

from foundpose.matching.base import Matches

MatchingMode = Literal["nearest", "cyclic"]

# Distances between all patches exist for one block of (crop, template) pairs at a time: 64 MiB in float32.
_DISTANCES_PER_BLOCK = 1 << 24


def nearest_patches(
    query: Tensor, query_valid: Tensor, template: Tensor, template_valid: Tensor, with_return: bool
) -> tuple[Tensor, Tensor | None]:
    """Nearest valid template patch of each query patch, and optionally the way back.

    Args:
        query: (n, P, d) descriptors.
        query_valid: (n, P) bool.
        template: (n, Q, d) descriptors.
        template_valid: (n, Q) bool.
        with_return: whether to search the other direction too.

    Returns:
        Template patch of each query patch (n, P), and the nearest valid query patch of that template patch
        (n, P) or None. Of equally near patches the one with the lowest index; meaningless where there is none.

    Not differentiable (indices).
    """
    query, template = query.detach(), template.detach()
    template_norm = template.square().sum(dim=-1).masked_fill(~template_valid, torch.inf)
    # |q|² is the same for all template patches, so one direction does not need it.
    score = torch.baddbmm(template_norm.unsqueeze(1), query, template.transpose(1, 2), alpha=-2.0)
    forth = score.argmin(dim=2)
    if not with_return:
        return forth, None
    query_norm = query.square().sum(dim=-1).masked_fill(~query_valid, torch.inf)
    back = (score + query_norm.unsqueeze(2)).argmin(dim=1)
    return forth, back.gather(1, forth)


def keep_best(valid: Tensor, cycle: Tensor | None, distance: Tensor, top_k: int) -> Tensor:
    """Mask of the ``top_k`` matches with the smallest cycle distance, then descriptor distance, then index.

    Args:
        valid: (..., P) bool, candidates.
        cycle: (..., P) cycle distances in pixels, or None to rank by descriptor distance alone.
        distance: (..., P) descriptor distances.
        top_k: number of matches to keep.

    Returns:
        (..., P) bool, a subset of ``valid``.
    """
    # Lexicographic order: stable sorts from the last key to the first. Not valid: +inf, so last.
    order = distance.detach().masked_fill(~valid, torch.inf).sort(dim=-1, stable=True).indices
    if cycle is not None:
        by_distance = cycle.detach().masked_fill(~valid, torch.inf).gather(-1, order)
        order = order.gather(-1, by_distance.sort(dim=-1, stable=True).indices)
    return torch.zeros_like(valid).scatter(-1, order[..., :top_k], True) & valid


def match_patches(
    query: Tensor,
    query_valid: Tensor,
    template: Tensor,
    template_valid: Tensor,
    query_pixels: Tensor | None,
    top_k: int | None,
) -> Matches:
    """Match B crops to h templates each; shapes as in `PatchMatcher.forward`.

    Args:
        query: (B, P, d), finite.
        query_valid: (B, P) bool.
        template: (B, h, Q, d), finite.
        template_valid: (B, h, Q) bool.
        query_pixels: (B, P, 2) to rank matches by cycle distance, or None.
        top_k: number of matches to keep per template, or None for all.

    Returns:
        The matches. Differentiable w.r.t. the descriptors through the distances.
    """
    B, h, Q = template_valid.shape
    P = query.shape[1]
    if min(B, h, P, Q) == 0:
        nothing = query_valid.new_zeros(B, h, P)
        return Matches(nothing.long(), query.new_full((B, h, P), torch.inf), nothing)
    pairs = max(1, _DISTANCES_PER_BLOCK // (P * Q))
    template, template_valid = template.flatten(0, 1), template_valid.flatten(0, 1)
    crop = torch.arange(B * h, device=query.device) // h
    patch, distance, valid = [], [], []
    for start in range(0, B * h, pairs):
        block = slice(start, start + pairs)
        q, q_valid, t, t_valid = (
            query[crop[block]],
            query_valid[crop[block]],
            template[block],
            template_valid[block],
        )
        forth, back = nearest_patches(q, q_valid, t, t_valid, query_pixels is not None)
        ok = q_valid & t_valid.any(dim=1, keepdim=True)
        nearest = t.gather(1, forth.unsqueeze(-1).expand_as(q))
        # From the difference, not from the expanded square: accurate near zero.
        length = torch.linalg.vector_norm(q - nearest, dim=-1)
        if top_k is not None:
            cycle = None
            if query_pixels is not None and back is not None:
                pixels = query_pixels[crop[block]]
                cycle = torch.linalg.vector_norm(
                    pixels - pixels.gather(1, back.unsqueeze(-1).expand_as(pixels)), dim=-1
                )
            ok = keep_best(ok, cycle, length, top_k)
        patch.append(forth.masked_fill(~ok, 0))
        distance.append(length.masked_fill(~ok, torch.inf))
        valid.append(ok)
    return Matches(*(torch.cat(parts).unflatten(0, (B, h)) for parts in (patch, distance, valid)))


class PatchMatcher(nn.Module):
    """Matches each patch of a crop to the nearest patch (Euclidean) of each retrieved template.

    Args:
        mode: "nearest": one-way nearest neighbour (the paper). "cyclic": matches are ranked by the distance
            in the crop between a patch and the patch to which the template's patch matches back.
        top_k: keep this many matches per template, the best first by cycle distance (in mode "cyclic"), then by
            descriptor distance, then by index; None keeps all, and then both modes give the same.

    Source: paper, "Crop-to-template patch matching"; cyclic: Goodwin et al., ECCV 2022.
    """

    def __init__(self, mode: MatchingMode = "nearest", top_k: int | None = None) -> None:
        super().__init__()
        if mode not in ("nearest", "cyclic"):
            raise ValueError(f"mode must be 'nearest' or 'cyclic', got {mode!r}")
        if top_k is not None and top_k < 1:
            raise ValueError(f"top_k must be at least 1 or None, got {top_k}")
        self.mode = mode
        self.top_k = top_k

    def forward(
        self,
        query_descriptors: Tensor,
        query_valid: Tensor,
        template_descriptors: Tensor,
        template_valid: Tensor,
        query_pixels: Tensor,
    ) -> Matches:
        """Match B crops with h templates each.

        Args:
            query_descriptors: (B, P, d).
            query_valid: (B, P) bool.
            template_descriptors: (B, h, Q, d).
            template_valid: (B, h, Q) bool.
            query_pixels: (B, P, 2) patch centres in the crop, pixels (read in mode "cyclic" only).

        Returns:
            One match per crop patch and template; not valid where the patch is not, where the template has no
            valid patch, or where ``top_k`` better ones exist. What stands in rows that are not valid (as long
            as it is finite) has no influence.

        Raises:
            ValueError: If shapes do not fit.

        Differentiable w.r.t. the descriptors through ``distance``; the choice of patches is constant.
        """
        _check_shapes(query_descriptors, query_valid, template_descriptors, template_valid, query_pixels)
        return match_patches(
            query_descriptors,
            query_valid,
            template_descriptors,
            template_valid,
            query_pixels if self.mode == "cyclic" else None,
            self.top_k,
        )

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"mode={self.mode!r}, top_k={self.top_k}"


def _check_shapes(
    query: Tensor, query_valid: Tensor, template: Tensor, template_valid: Tensor, pixels: Tensor
) -> None:
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

"""Proposals of Segment Anything: the masks of a grid of points."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.detection.proposals import (
    Pictures,
    Proposals,
    Proposer,
    mask_overlaps,
    pad_proposals,
    suppress,
)
from foundpose.features.pretrained import IMAGENET_MEAN, IMAGENET_STD
from foundpose.features.weights import check_seed, from_hub_or_folder

# Side of the squares that both generations of the network take.
_SIDE = 1024


class SamProposer(Proposer):
    """Masks that SAM or SAM 2 makes of each point of a grid, without those that are uncertain or said twice.

    Args:
        variant: ``sam_vitb``, ``sam_vitl``, ``sam_vith``, or ``sam2_tiny``, ``sam2_small``, ``sam2_base_plus``,
            ``sam2_large`` (SAM 2.1).
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, or ``"random"`` (with
            ``seed``; for tests and dry runs).
        points: along each side of the grid.
        points_per_batch: that are decoded at a time.
        min_quality: masks of which the network expects a smaller overlap with the true one are dropped.
        min_stability: masks that change more when their threshold moves by ``margin`` are dropped: smallest share of
            the larger mask that the smaller has.
        margin: of the logits, for stability.
        overlap: of masks that overlap by more than this, the one of the best quality is kept.
        min_pixels: smaller masks are dropped.
        max_proposals: in a picture, those of the best quality.
        seed: of random weights, and only of these.
        config: sizes in place of the variant's, under transformers' names; with random weights only.

    Raises:
        ValueError: an argument out of range, or weights of another model.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: Kirillov et al., "Segment Anything", 2023, Section 5 and Appendix B; Ravi et al., "SAM 2", 2024.
    """

    repositories: ClassVar[Mapping[str, str]] = {
        "sam_vitb": "facebook/sam-vit-base",
        "sam_vitl": "facebook/sam-vit-large",
        "sam_vith": "facebook/sam-vit-huge",
        "sam2_tiny": "facebook/sam2.1-hiera-tiny",
        "sam2_small": "facebook/sam2.1-hiera-small",
        "sam2_base_plus": "facebook/sam2.1-hiera-base-plus",
        "sam2_large": "facebook/sam2.1-hiera-large",
    }

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        variant: str = "sam_vith",
        weights: str | Path = "hub",
        points: int = 32,
        points_per_batch: int = 64,
        min_quality: float = 0.88,
        min_stability: float = 0.95,
        margin: float = 1.0,
        overlap: float = 0.7,
        min_pixels: int = 100,
        max_proposals: int = 300,
        seed: int | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if variant not in self.repositories:
            raise ValueError(f"variant must be one of {', '.join(self.repositories)}, got {variant!r}")
        for name, count in (("points", points), ("points_per_batch", points_per_batch)):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}")
        check_seed(weights, seed)
        if (config is not None) and seed is None:
            raise ValueError("config goes with weights='random'; other weights bring their own")
        self.variant = variant
        self.points = points
        self.points_per_batch = points_per_batch
        self.min_quality = min_quality
        self.min_stability = min_stability
        self.margin = margin
        self.overlap = overlap
        self.min_pixels = min_pixels
        self.max_proposals = max_proposals
        self.model: Any = _load(variant, weights, self.repositories[variant], seed, dict(config or {})).eval()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    @torch.no_grad()
    def forward(self, pictures: Pictures) -> Proposals:
        """Masks of pictures, the best first; the score is the overlap with the true mask that the network expects."""
        masks, scores = [], []
        for image in pictures.images:
            mask, quality = self._masks_of(image)
            masks.append(mask)
            scores.append(quality)
        return pad_proposals(masks, scores)

    def _masks_of(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Masks (P, H, W) of a picture (3, H, W), and their expected quality."""
        height, width = image.shape[-2:]
        square, inside = self._to_square(image)
        embeddings = self.model.get_image_embeddings(square[None])
        kept: list[Tensor] = []
        qualities: list[Tensor] = []
        for points in self._grid(inside, image.device).split(self.points_per_batch):
            said = self.model(image_embeddings=embeddings, input_points=points[None, :, None])
            logits, quality = said.pred_masks[0].flatten(0, 1), said.iou_scores[0].flatten()
            larger = (logits > -self.margin).flatten(1).sum(1)
            stability = (logits > self.margin).flatten(1).sum(1) / larger.clamp_min(1)
            good = (quality >= self.min_quality) & (stability >= self.min_stability)
            if not bool(good.any()):
                continue
            mask = _to_picture(logits[good], inside, (height, width))
            large = mask.flatten(1).sum(1) >= self.min_pixels
            kept.append(mask[large])
            qualities.append(quality[good][large])
        if not kept:
            return image.new_zeros(0, height, width, dtype=torch.bool), image.new_zeros(0)
        masks, quality = torch.cat(kept), torch.cat(qualities).clamp(0, 1)
        best = suppress(mask_overlaps(masks), quality, self.overlap)[: self.max_proposals]
        return masks[best], quality[best]

    def _to_square(self, image: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """The network's input (3, 1024, 1024), and how many of its rows and columns are the picture."""
        height, width = image.shape[-2:]
        inside = (_SIDE, _SIDE)
        if not self.variant.startswith("sam2"):  # keeps the proportions, SAM 2 does not
            scale = _SIDE / max(height, width)
            inside = (round(height * scale), round(width * scale))
        resized = F.interpolate(image[None], inside, mode="bilinear", align_corners=False, antialias=True)[0]
        normal = (resized - self.mean) / self.std
        return F.pad(normal, (0, _SIDE - inside[1], 0, _SIDE - inside[0])), inside

    def _grid(self, inside: tuple[int, int], device: torch.device) -> Tensor:
        """Points (n², 2) as ``(u, v)`` of the network's input, in the middle of equal cells of the picture."""
        steps = (torch.arange(self.points, device=device) + 0.5) / self.points
        v, u = torch.meshgrid(steps * inside[0], steps * inside[1], indexing="ij")
        return torch.stack([u, v], dim=-1).reshape(-1, 2)


def _to_picture(logits: Tensor, inside: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Masks (P, H, W) bool of logits (P, h, w), which cover the network's square input."""
    large = F.interpolate(logits[None], (_SIDE, _SIDE), mode="bilinear", align_corners=False)
    part = large[..., : inside[0], : inside[1]]
    return F.interpolate(part, size, mode="bilinear", align_corners=False)[0] > 0


def _load(
    variant: str, weights: str | Path, repository: str, seed: int | None, config: dict[str, Any]
) -> nn.Module:
    from transformers import Sam2Config, Sam2Model, SamConfig, SamModel

    model, settings = (Sam2Model, Sam2Config) if variant.startswith("sam2") else (SamModel, SamConfig)
    if seed is not None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return model(settings(**config))

    def load(source: str) -> nn.Module:
        loaded, info = model.from_pretrained(source, output_loading_info=True, dtype=torch.float32)
        if info["missing_keys"] or info["mismatched_keys"]:
            raise ValueError(
                f"the weights in {source} are not those of {variant}: missing {sorted(info['missing_keys'])[:5]}"
            )
        return loaded

    how = (
        f"On a machine with a network run\n  hf download {repository} --local-dir DIR\nand pass weights=DIR. "
        "detector=regions needs no weights of a segmenter"
    )
    return from_hub_or_folder(load, weights, repository, how)

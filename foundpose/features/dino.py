"""Patch descriptors of layers of DINO, DINOv2's predecessor."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn

from foundpose.features.base import PatchFeatures
from foundpose.features.pretrained import PATCH_SIZE
from foundpose.features.vision_transformer import VisionTransformer, split_tokens
from foundpose.features.weights import Sizes


def _dino(width: int, heads: int, patch_size: int) -> Sizes:
    return {
        "hidden_size": width,
        "num_hidden_layers": 12,
        "num_attention_heads": heads,
        "intermediate_size": 4 * width,
        "patch_size": patch_size,
        "image_size": 224,  # that the position embeddings were made for
    }


class Dino(VisionTransformer):
    """Patch descriptors from a layer of DINO.

    Variants: ``vits8`` (the default), ``vits16``, ``vitb8``, ``vitb16``. Crops of 420 px become 240 px for 8 px
    patches and 480 px for 16 px; the position embeddings are resampled to the grid (bicubic). The default layer is
    the last; the final LayerNorm is applied by default. Arguments: see :class:`VisionTransformer`.

    Source: Caron et al., "Emerging Properties in Self-Supervised Vision Transformers", ICCV 2021 (sizes: table 1); as
    the backbone of a pose estimator: Ausserlechner et al., "ZS6D", ICRA 2024.
    """

    variants: ClassVar[Mapping[str, Sizes]] = {
        "vits8": _dino(384, 6, 8),
        "vits16": _dino(384, 6, 16),
        "vitb8": _dino(768, 12, 8),
        "vitb16": _dino(768, 12, 16),
    }
    default_variant = "vits8"
    tail = "layernorm"

    @staticmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
        from transformers import ViTConfig

        return ViTConfig(**{**sizes, "num_hidden_layers": blocks})

    @staticmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub, e.g. ``facebook/dino-vits8``."""
        return f"facebook/dino-{variant}"

    @staticmethod
    def adapt(model: nn.Module, variant: str) -> None:
        """Drop the pooling layer, which the checkpoints do not have."""
        model.register_module("pooler", None)

    def input_size(self, image_size: int) -> int:
        """One patch of the network per patch of the grid."""
        return image_size // PATCH_SIZE * self.sizes["patch_size"]

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        return split_tokens(
            self.model(pixel_values=pixels, interpolate_pos_encoding=True).last_hidden_state, 1
        )

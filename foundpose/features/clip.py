"""Patch descriptors of CLIP's image encoder through transformers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchFeatures
from foundpose.features.pretrained import PATCH_SIZE, PretrainedExtractor, resolve_architecture, split_tokens
from foundpose.features.weights import (
    ConfigValue,
    how_to_get_hub_weights,
    load_transformers,
    random_transformers,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class ClipArchitecture(NamedTuple):
    """Sizes of a variant, under the names that transformers' configuration has.

    Attributes:
        hidden_size: width C of the tokens.
        num_hidden_layers: number of blocks.
        num_attention_heads: heads per block.
        intermediate_size: hidden width of the MLP.
        patch_size: of the network's own patches, pixels.
        image_size: side in pixels of the images that the position embeddings were made for.
        hidden_act: activation of the MLP; OpenAI's models have ``quick_gelu``, others ``gelu``.
    """

    hidden_size: int
    num_hidden_layers: int
    num_attention_heads: int
    intermediate_size: int
    patch_size: int
    image_size: int = 224
    hidden_act: str = "quick_gelu"


# Sizes: Radford et al., "Learning Transferable Visual Models From Natural Language Supervision", 2021, table 20.
VARIANTS: dict[str, ClipArchitecture] = {
    "vitb32": ClipArchitecture(768, 12, 12, 3072, 32),
    "vitb16": ClipArchitecture(768, 12, 12, 3072, 16),
    "vitl14": ClipArchitecture(1024, 24, 16, 4096, 14),
    "vitl14_336": ClipArchitecture(1024, 24, 16, 4096, 14, 336),
}
_REPOSITORIES = {
    "vitb32": "openai/clip-vit-base-patch32",
    "vitb16": "openai/clip-vit-base-patch16",
    "vitl14": "openai/clip-vit-large-patch14",
    "vitl14_336": "openai/clip-vit-large-patch14-336",
}


class Clip(PretrainedExtractor):
    """Patch descriptors from a layer of CLIP's image encoder.

    Crops are resized so that the network's patches are those of the grid (420 px stay for 14 px patches, become
    480 px for 16 px and 960 px for 32 px), and its position embeddings are resampled to the grid (bicubic). Only
    the blocks up to the hooked layer are built and run.

    Args:
        variant: ``vitb32``, ``vitb16``, ``vitl14`` or ``vitl14_336``.
        layer: block whose output is taken, counted from 0; the last of a ViT-L is 23, of a ViT-B 11.
        final_norm: apply the LayerNorm that the model has for the class token of its last block to all tokens.
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, or ``"random"`` (with
            ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``ClipArchitecture``.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: "Ablation experiments" of the paper; Radford et al., "Learning Transferable Visual Models From Natural
    Language Supervision", 2021.
    """

    def __init__(
        self,
        variant: str = "vitl14",
        layer: int = 23,
        final_norm: bool = False,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> None:
        architecture = resolve_architecture(VARIANTS, variant, config, layer, weights, precision, seed)
        model = _load(weights, seed, build_config(architecture, layer + 1), architecture, variant)
        if not final_norm:
            _encoder(model).post_layernorm = nn.Identity()
        settings: Fingerprint = {"variant": variant, "layer": layer, "final_norm": final_norm}
        width = architecture.hidden_size
        super().__init__(
            model, width, settings, True, precision, mean=CLIP_MEAN, std=CLIP_STD, compile=compile
        )
        self.patch_size = architecture.patch_size

    def input_size(self, image_size: int) -> int:
        """One patch of the network per patch of the grid."""
        return image_size // PATCH_SIZE * self.patch_size

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        tokens = self.model(pixel_values=pixels, interpolate_pos_encoding=True).last_hidden_state
        return split_tokens(_encoder(self.model).get_submodule("post_layernorm")(tokens), 1)


def build_config(architecture: ClipArchitecture, blocks: int) -> Any:
    """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
    from transformers import CLIPVisionConfig

    return CLIPVisionConfig(**architecture._asdict() | {"num_hidden_layers": blocks})


def _encoder(model: nn.Module) -> nn.Module:
    """The transformer itself, which some versions of transformers wrap once more."""
    return getattr(model, "vision_model", model)


def _load(
    weights: str | Path, seed: int | None, config: Any, architecture: ClipArchitecture, variant: str
) -> nn.Module:
    if seed is not None:
        return random_transformers(config, seed)
    from transformers import CLIPVisionModel

    repository = _REPOSITORIES[variant]
    return load_transformers(
        weights,
        repository,
        CLIPVisionModel,
        config,
        architecture,
        variant,
        VARIANTS,
        how_to_get_hub_weights(variant, repository),
    )

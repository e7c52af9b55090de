"""Patch descriptors of Segment Anything's image encoder through transformers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchFeatures
from foundpose.features.pretrained import PretrainedExtractor, resolve_architecture
from foundpose.features.weights import (
    ConfigValue,
    how_to_get_hub_weights,
    load_transformers,
    random_transformers,
)


class SamArchitecture(NamedTuple):
    """Sizes of a variant, under the names that transformers' configuration has.

    Attributes:
        hidden_size: width C of the tokens.
        num_hidden_layers: number of blocks.
        num_attention_heads: heads per block.
        global_attn_indexes: blocks that attend to the whole image; the others attend within windows.
        mlp_dim: hidden width of the MLP.
        image_size: side in pixels of the network's input; its position embeddings fit no other.
        patch_size: of the network's own patches, pixels.
        window_size: side of the windows, tokens.
    """

    hidden_size: int
    num_hidden_layers: int
    num_attention_heads: int
    global_attn_indexes: tuple[int, ...]
    mlp_dim: int
    image_size: int = 1024
    patch_size: int = 16
    window_size: int = 14


# Sizes: Kirillov et al., "Segment Anything", 2023, and the released model definitions.
VARIANTS: dict[str, SamArchitecture] = {
    "vitb": SamArchitecture(768, 12, 12, (2, 5, 8, 11), 3072),
    "vitl": SamArchitecture(1024, 24, 16, (5, 11, 17, 23), 4096),
    "vith": SamArchitecture(1280, 32, 16, (7, 15, 23, 31), 5120),
}
_REPOSITORIES = {
    "vitb": "facebook/sam-vit-base",
    "vitl": "facebook/sam-vit-large",
    "vith": "facebook/sam-vit-huge",
}


class Sam(PretrainedExtractor):
    """Patch descriptors from a layer of Segment Anything's image encoder, before its neck.

    The network takes images of 1024 px only, to which a crop is enlarged; its 64 × 64 tokens are sampled at the
    centres of the grid's patches. There is no global descriptor, and no LayerNorm between the last block and the
    neck. Only the blocks up to the hooked layer are built and run.

    Args:
        variant: ``vitb``, ``vitl`` or ``vith``.
        layer: block whose output is taken, counted from 0.
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, with or without the
            mask decoder, or ``"random"`` (with ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``SamArchitecture``.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: "Ablation experiments" of the paper; Kirillov et al., "Segment Anything", 2023.
    """

    def __init__(
        self,
        variant: str = "vitl",
        layer: int = 23,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> None:
        architecture = resolve_architecture(VARIANTS, variant, config, layer, weights, precision, seed)
        model = _load(weights, seed, build_config(architecture, layer + 1), architecture, variant)
        model.get_submodule("vision_encoder").neck = nn.Identity()
        settings: Fingerprint = {"variant": variant, "layer": layer}
        super().__init__(
            model, architecture.hidden_size, settings, has_cls=False, precision=precision, compile=compile
        )
        self.image_size = architecture.image_size

    def input_size(self, image_size: int) -> int:
        """The only size that the network takes."""
        return self.image_size

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        tokens = self.model(pixel_values=pixels).last_hidden_state
        return PatchFeatures(tokens.permute(0, 3, 1, 2), None)


def build_config(architecture: SamArchitecture, blocks: int) -> Any:
    """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
    from transformers import SamVisionConfig

    # transformers' default range of random weights, 1e-10, would make all random descriptors the same
    settings = architecture._asdict() | {"num_hidden_layers": blocks, "initializer_range": 0.02}
    return SamVisionConfig(**settings)


def _load(
    weights: str | Path, seed: int | None, config: Any, architecture: SamArchitecture, variant: str
) -> nn.Module:
    if seed is not None:
        return random_transformers(config, seed)
    from transformers import SamVisionModel

    repository = _REPOSITORIES[variant]
    return load_transformers(
        weights,
        repository,
        SamVisionModel,
        config,
        architecture,
        variant,
        VARIANTS,
        how_to_get_hub_weights(variant, repository),
    )

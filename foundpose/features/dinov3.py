"""DINOv3 patch descriptors through transformers."""

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

_CELL = 16  # pixels of the network's own patches


class DinoV3Architecture(NamedTuple):
    """Sizes of a variant, under the names that transformers' configuration has.

    Attributes:
        hidden_size: width C of the tokens.
        num_hidden_layers: number of blocks.
        num_attention_heads: heads per block; rotary embeddings want a width of a multiple of 4 per head.
        intermediate_size: hidden width of the MLP.
        use_gated_mlp: SwiGLU in place of a two-layer MLP.
        hidden_act: activation of the MLP.
        query_bias: the projections to queries have a bias.
        value_bias: the projections to values have a bias.
        num_register_tokens: registers beside the class token.
    """

    hidden_size: int
    num_hidden_layers: int
    num_attention_heads: int
    intermediate_size: int
    use_gated_mlp: bool = False
    hidden_act: str = "gelu"
    query_bias: bool = True
    value_bias: bool = True
    num_register_tokens: int = 4


# Sizes: Siméoni et al., "DINOv3", 2025, and the released model definitions.
VARIANTS: dict[str, DinoV3Architecture] = {
    "vits16": DinoV3Architecture(384, 12, 6, 1536),
    "vits16plus": DinoV3Architecture(384, 12, 6, 1536, True, "silu"),
    "vitb16": DinoV3Architecture(768, 12, 12, 3072),
    "vitl16": DinoV3Architecture(1024, 24, 16, 4096),
    "vith16plus": DinoV3Architecture(1280, 32, 20, 5120, True, "silu"),
    "vit7b16": DinoV3Architecture(4096, 40, 32, 8192, True, "silu", False, False),
}


class DinoV3(PretrainedExtractor):
    """Patch descriptors from a layer of DINOv3 (trained on LVD-1689M).

    The network's patches have 16 px, so a crop is enlarged by 16/14 (420 px to 480 px), and its patches are then
    those of the grid. Only the blocks up to the hooked layer are built and run.

    Args:
        variant: ``vits16``, ``vits16plus``, ``vitb16``, ``vitl16``, ``vith16plus`` or ``vit7b16``.
        layer: block whose output is taken, counted from 0.
        final_norm: apply the model's final LayerNorm to these tokens.
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, or ``"random"`` (with
            ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``DinoV3Architecture``.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: Siméoni et al., "DINOv3", 2025.
    """

    def __init__(
        self,
        variant: str = "vitl16",
        layer: int = 18,
        final_norm: bool = True,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> None:
        architecture = resolve_architecture(VARIANTS, variant, config, layer, weights, precision, seed)
        model = _load(weights, seed, build_config(architecture, layer + 1), architecture, variant)
        if not final_norm:
            model.norm = nn.Identity()
        settings: Fingerprint = {"variant": variant, "layer": layer, "final_norm": final_norm}
        super().__init__(
            model, architecture.hidden_size, settings, has_cls=True, precision=precision, compile=compile
        )
        self.num_prefix_tokens = 1 + architecture.num_register_tokens

    def input_size(self, image_size: int) -> int:
        """16 px per patch of the grid."""
        return image_size // PATCH_SIZE * _CELL

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        return split_tokens(self.model(pixel_values=pixels).last_hidden_state, self.num_prefix_tokens)


def hub_repository(variant: str) -> str:
    """Repository on the Hugging Face hub, e.g. ``facebook/dinov3-vitl16-pretrain-lvd1689m``."""
    return f"facebook/dinov3-{variant}-pretrain-lvd1689m"


def build_config(architecture: DinoV3Architecture, blocks: int) -> Any:
    """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
    from transformers import DINOv3ViTConfig

    return DINOv3ViTConfig(**architecture._asdict() | {"num_hidden_layers": blocks}, patch_size=_CELL)


def _load(
    weights: str | Path, seed: int | None, config: Any, architecture: DinoV3Architecture, variant: str
) -> nn.Module:
    if seed is not None:
        return random_transformers(config, seed)
    from transformers import DINOv3ViTModel

    repository = hub_repository(variant)
    licence = f"(accept the licence at https://huggingface.co/{repository} first, and `hf auth login`) "
    return load_transformers(
        weights,
        repository,
        DINOv3ViTModel,
        config,
        architecture,
        variant,
        VARIANTS,
        how_to_get_hub_weights(variant, repository, licence),
    )

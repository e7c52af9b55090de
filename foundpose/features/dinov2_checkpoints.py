"""DINOv2 variants, where the original checkpoints are, and their conversion.

The original checkpoints (``dinov2_vitl14_reg4_pretrain.pth`` and so on) are translated to the key names of the
checkpoints on the Hugging Face hub, which every version of transformers reads, rather than to the names of its
modules, which change between versions.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from foundpose.features.weights import Sizes, check_sizes, read_checkpoint

PATCH_SIZE = 14
HUB_NAMES = {"vits14": "small", "vitb14": "base", "vitl14": "large", "vitg14": "giant"}


def _sizes(width: int, depth: int, heads: int, registers: int) -> Sizes:
    return {
        "hidden_size": width,
        "num_hidden_layers": depth,
        "num_attention_heads": heads,
        "use_swiglu_ffn": depth == 40,  # in place of a two-layer MLP
        "num_register_tokens": registers,
        "mlp_ratio": 4,
        "image_size": 518,  # that the position embeddings were made for
    }


# Oquab et al., "DINOv2", table 16 and the released model definitions; registers: Darcet et al.
VARIANTS: dict[str, Sizes] = {
    f"{name}{suffix}": _sizes(width, depth, heads, registers)
    for name, width, depth, heads in (
        ("vits14", 384, 12, 6),
        ("vitb14", 768, 12, 12),
        ("vitl14", 1024, 24, 16),
        ("vitg14", 1536, 40, 24),
    )
    for suffix, registers in (("", 0), ("_reg", 4))
}


def original_checkpoint_url(variant: str) -> str:
    """Address of the original checkpoint file."""
    backbone = variant.removesuffix("_reg")
    registers = "_reg4" if variant.endswith("_reg") else ""
    return (
        f"https://dl.fbaipublicfiles.com/dinov2/dinov2_{backbone}/dinov2_{backbone}{registers}_pretrain.pth"
    )


def read_original(path: Path, sizes: Sizes, how: str) -> Mapping[str, Tensor]:
    """State dictionary of an original ``.pth`` checkpoint.

    Args:
        path: the file.
        sizes: what it must have.
        how: instructions to get the weights.

    Raises:
        ValueError: the weights are those of another model or variant.
    """
    state = read_checkpoint(path, how)
    if "pos_embed" not in state or "blocks.0.norm1.weight" not in state:
        raise ValueError(
            f"{path} is not an original DINOv2 backbone checkpoint (keys such as pos_embed and "
            f"blocks.0.norm1.weight); it holds {list(state)[:5]}"
        )
    check_sizes(original_sizes(state), sizes, str(path), VARIANTS)
    return state


def original_sizes(state: Mapping[str, Tensor]) -> Sizes:
    """Sizes that can be read from an original checkpoint (all but the number of heads)."""
    width = state["pos_embed"].shape[-1]
    swiglu = "blocks.0.mlp.w12.weight" in state
    sizes = {
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


def convert_original(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Translate an original checkpoint's state dictionary to the key names of the hub's checkpoints."""
    converted: dict[str, Tensor] = {}
    for original, value in state.items():
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

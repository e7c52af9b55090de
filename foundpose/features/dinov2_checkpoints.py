"""DINOv2 variants, where their weights are, and the conversion of the original checkpoints.

The original checkpoints (``dinov2_vitl14_reg4_pretrain.pth`` and so on) are translated to the key names of the
checkpoints on the Hugging Face hub, which every version of transformers reads, rather than to the names of its
modules, which change between versions.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

PATCH_SIZE = 14

ConfigValue = int | float | bool


class WeightsNotFoundError(FileNotFoundError):
    """Weights are neither on this machine nor could they be fetched; the message says how to get them."""


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
    repository, url = hub_repository(variant), original_checkpoint_url(variant)
    return (
        f"To get the weights of {variant}, on a machine with a network either run\n"
        f"  hf download {repository} --local-dir DIR\n"
        f"and pass weights=DIR, or download the original checkpoint\n"
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
    path = Path(source)
    if source == "hub":
        return _load_transformers(hub_repository(variant), variant, architecture, blocks)
    if path.is_dir():
        return _load_transformers(str(path), variant, architecture, blocks)
    if path.is_file():
        return _load_original(path, variant, architecture, blocks)
    raise WeightsNotFoundError(f"no DINOv2 weights at {path}.\n{how_to_get_weights(variant)}")


def _load_transformers(source: str, variant: str, architecture: DinoV2Architecture, blocks: int) -> nn.Module:
    from transformers import AutoConfig

    config = build_config(architecture, blocks)
    try:
        found = AutoConfig.from_pretrained(source)
        if found.model_type != config.model_type:
            raise ValueError(
                f"{source} holds a {found.model_type!r} model, but variant {variant} is {config.model_type!r}"
            )
        _check_sizes({name: getattr(found, name, 0) for name in architecture._fields}, architecture, source)
        return _from_pretrained(source, config, None, architecture, source)
    except OSError as error:
        raise WeightsNotFoundError(
            f"could not load DINOv2 weights from {source}: {error}\n{how_to_get_weights(variant)}"
        ) from error


def _load_original(path: Path, variant: str, architecture: DinoV2Architecture, blocks: int) -> nn.Module:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(
            f"{path} is not a checkpoint that torch.load can read: {error}\n{how_to_get_weights(variant)}"
        ) from error
    if not isinstance(state, Mapping) or "pos_embed" not in state or "blocks.0.norm1.weight" not in state:
        names = list(state)[:5] if isinstance(state, Mapping) else type(state).__name__
        raise ValueError(
            f"{path} is not an original DINOv2 backbone checkpoint (keys such as pos_embed and "
            f"blocks.0.norm1.weight); it holds {names}"
        )
    found = original_architecture(state) | {"num_attention_heads": architecture.num_attention_heads}
    _check_sizes(found, architecture, str(path))
    config = build_config(architecture, blocks)
    return _from_pretrained(None, config, convert_original(state, blocks), architecture, str(path))


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


def _check_sizes(found: Mapping[str, ConfigValue], architecture: DinoV2Architecture, source: str) -> None:
    wanted = architecture._asdict()
    wrong = {name: value for name, value in found.items() if value != wanted[name]}
    if wrong:
        differences = ", ".join(f"{name} {value} instead of {wanted[name]}" for name, value in wrong.items())
        raise ValueError(
            f"the weights in {source} do not fit the variant asked for: {differences}; "
            f"choose the variant that they belong to, one of {', '.join(VARIANTS)}"
        )


def _from_pretrained(
    source: str | None,
    config: Any,
    state: dict[str, Tensor] | None,
    architecture: DinoV2Architecture,
    origin: str,
) -> nn.Module:
    with _quiet_transformers():
        model, info = model_class(architecture).from_pretrained(
            source,
            config=config,
            state_dict=state,
            attn_implementation="sdpa",
            dtype=torch.float32,
            output_loading_info=True,
        )
    # The blocks behind the hooked layer are left unread on purpose; nothing that was built may stay unread.
    if info["missing_keys"] or info["mismatched_keys"]:
        raise ValueError(
            f"the weights in {origin} are incomplete: missing {sorted(info['missing_keys'])[:5]}, "
            f"of the wrong shape {sorted(info['mismatched_keys'])[:5]}"
        )
    return model


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Keep transformers from reporting the blocks that are left out on purpose, and from drawing bars."""
    from transformers.utils import logging

    verbosity, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bar:
            logging.enable_progress_bar()

"""DINOv2 patch descriptors through transformers."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.features.checks import check_images
from foundpose.features.dinov2_checkpoints import (
    PATCH_SIZE,
    VARIANTS,
    ConfigValue,
    DinoV2Architecture,
    build_config,
    load_pretrained,
)

_AUTOCAST = {"bf16": torch.bfloat16, "fp16": torch.float16}
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class DinoV2(PatchExtractor):
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
            checkpoint, or ``"random"`` (with ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast; None in the weights' own precision.
        seed: of random weights, and only of these.
        config: sizes that differ from the variant's, names as in ``DinoV2Architecture``.

    Raises:
        ValueError: unknown variant, layer or precision; weights that do not fit the variant.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: section 3.1 of the paper; Oquab et al., "DINOv2", 2023; Darcet et al., "Vision Transformers Need
    Registers", 2024.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        variant: str = "vitl14_reg",
        layer: int = 18,
        final_norm: bool = True,
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        config: Mapping[str, ConfigValue] | None = None,
    ) -> None:
        architecture = _architecture(variant, config)
        if not 0 <= layer < architecture.num_hidden_layers:
            raise ValueError(
                f"layer must be in 0..{architecture.num_hidden_layers - 1} for {variant}, got {layer}"
            )
        if precision is not None and precision not in _AUTOCAST:
            raise ValueError(f"precision must be None, 'bf16' or 'fp16', got {precision!r}")
        if (weights == "random") != (seed is not None):
            raise ValueError(f"weights='random' goes with a seed, got weights={weights!r} and seed={seed}")
        super().__init__(architecture.hidden_size, stride=PATCH_SIZE, offset=(PATCH_SIZE - 1) / 2)
        self.variant = variant
        self.layer = layer
        self.final_norm = final_norm
        self.precision = precision
        self.num_prefix_tokens = 1 + architecture.num_register_tokens
        if seed is not None:
            self.model = _random_model(architecture, layer + 1, seed)
        else:
            self.model = load_pretrained(weights, variant, architecture, layer + 1)
        if not architecture.num_register_tokens:
            self.model.embeddings = _original_embeddings(self.model)
        if not final_norm:
            self.model.layernorm = nn.Identity()
        self.model.eval()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    @classmethod
    def random_init(
        cls,
        variant: str = "vitl14_reg",
        layer: int = 18,
        final_norm: bool = True,
        precision: str | None = None,
        seed: int = 0,
        config: Mapping[str, ConfigValue] | None = None,
    ) -> Self:
        """An extractor with random weights, the same for the same seed: for tests and dry runs."""
        return cls(variant, layer, final_norm, "random", precision, seed, config)

    def forward(self, images: Tensor) -> PatchFeatures:
        """Describe the patches of images.

        Args:
            images: (B, 3, S, S) RGB in [0, 1]; S a multiple of 14 px.

        Returns:
            Patch descriptors (B, C, S/14, S/14) and the cls token (B, C), in the dtype of ``images``.

        Raises:
            ValueError: wrong shape, type, size or range of ``images``.

        Differentiable w.r.t. ``images`` and the parameters.
        """
        check_images(images, multiple_of=PATCH_SIZE)
        n = images.shape[-1] // PATCH_SIZE
        if not len(images):  # transformers' attention cannot reshape an empty batch
            return PatchFeatures(images.new_zeros(0, self.channels, n, n), images.new_zeros(0, self.channels))
        # normalised in at least single precision; the model casts to the dtype of its weights
        pixels = (images.to(torch.promote_types(images.dtype, self.mean.dtype)) - self.mean) / self.std
        autocast = _AUTOCAST.get(self.precision) if self.precision else None
        with torch.autocast(images.device.type, dtype=autocast, enabled=autocast is not None):
            tokens = self.model(pixel_values=pixels).last_hidden_state.to(images.dtype)
        patches = tokens[:, self.num_prefix_tokens :].unflatten(1, (n, n)).permute(0, 3, 1, 2)
        return PatchFeatures(patches, tokens[:, 0])

    def fingerprint(self) -> Fingerprint:
        """Variant, layer, final norm and a checksum of the weights as they are now; not the precision.

        Casting the weights (``half()``) changes their values and so the checksum; ``precision`` does not.
        """
        return {
            "extractor": "DinoV2",
            "variant": self.variant,
            "layer": self.layer,
            "final_norm": self.final_norm,
            "weights": weights_checksum(self.model),
        }

    def extra_repr(self) -> str:
        """Shown by ``print``."""
        return (
            f"variant={self.variant!r}, layer={self.layer}, final_norm={self.final_norm}, "
            f"precision={self.precision!r}"
        )


def weights_checksum(module: nn.Module) -> str:
    """SHA-256 over the values of a module's parameters, whatever their names, device and float type.

    Names are left out because they differ between versions of transformers, the mask token because it plays no
    part in inference.
    """
    digests = []
    for name, value in module.state_dict().items():
        if name.endswith("mask_token"):
            continue
        array = value.detach().to("cpu", torch.float32).contiguous().numpy()
        digest = hashlib.sha256(str(array.shape).encode())
        digest.update(array.data)
        digests.append(digest.digest())
    return hashlib.sha256(b"".join(sorted(digests))).hexdigest()


def resample_position_embeddings(embeddings: Tensor, rows: int, columns: int, offset: float = 0.1) -> Tensor:
    """Resample position embeddings as the original DINOv2 (without registers) does.

    Args:
        embeddings: (1, 1 + n², C), that of the cls token first.
        rows: new number of rows of patches.
        columns: new number of columns.
        offset: added to the new numbers when the scale factor is computed, not to the numbers themselves.

    Returns:
        (1, 1 + rows * columns, C). Differentiable w.r.t. ``embeddings``.
    """
    n = round((embeddings.shape[1] - 1) ** 0.5)
    if rows == n and columns == n:
        return embeddings
    # bicubic in half precision would move the embeddings
    grid = embeddings[:, 1:].to(torch.promote_types(embeddings.dtype, torch.float32))
    grid = nn.functional.interpolate(
        grid.unflatten(1, (n, n)).permute(0, 3, 1, 2),
        scale_factor=((rows + offset) / n, (columns + offset) / n),
        mode="bicubic",
    )
    return torch.cat([embeddings[:, :1], grid.flatten(2).transpose(1, 2).to(embeddings.dtype)], dim=1)


def _architecture(variant: str, config: Mapping[str, ConfigValue] | None) -> DinoV2Architecture:
    if variant not in VARIANTS:
        raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {variant!r}")
    unknown = set(config or {}) - set(DinoV2Architecture._fields)
    if unknown:
        raise ValueError(f"config has unknown keys {sorted(unknown)}; known: {DinoV2Architecture._fields}")
    architecture = VARIANTS[variant]._replace(**(config or {}))  # type: ignore[arg-type]  # fields of several types
    if bool(architecture.num_register_tokens) != variant.endswith("_reg"):
        raise ValueError(f"{variant} cannot have {architecture.num_register_tokens} register tokens")
    return architecture


def _random_model(architecture: DinoV2Architecture, blocks: int, seed: int) -> nn.Module:
    from transformers import AutoModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return AutoModel.from_config(build_config(architecture, blocks), attn_implementation="sdpa")


def _original_embeddings(model: nn.Module) -> nn.Module:
    from foundpose.features.dinov2_embeddings import OriginalDinov2Embeddings

    embeddings = OriginalDinov2Embeddings(model.config)
    embeddings.load_state_dict(model.get_submodule("embeddings").state_dict())
    return embeddings

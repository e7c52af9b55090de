"""Small, randomly initialised backbones for tests."""

from copy import deepcopy
from functools import cache
from typing import Any

import torch

from foundpose.features import Clip, Dino, DinoV3, LoftrBackbone, S2DNet, Sam
from foundpose.features.pretrained import PretrainedExtractor

SIZES = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 4}
DINOV3 = {**SIZES, "intermediate_size": 64}
CLIP = {**SIZES, "intermediate_size": 64}
SAM = {**SIZES, "mlp_dim": 64, "image_size": 128, "window_size": 3, "global_attn_indexes": [1, 3]}


def make(name: str, *args: Any, **kwargs: Any) -> PretrainedExtractor:
    """A small extractor by the name of the backbone, of its own; with seed 0 if there are no other settings."""
    return _build(name, *args, **kwargs) if args or kwargs else deepcopy(_usual(name))


@cache
def _usual(name: str) -> PretrainedExtractor:
    return _build(name)


def _build(name: str, seed: int | None = 0, weights: Any = "random", **kwargs: Any) -> PretrainedExtractor:
    settings: dict[str, Any] = {"seed": seed, "weights": weights}
    match name:
        case "dinov3":
            return DinoV3(**{"layer": 2, "config": DINOV3, **settings, **kwargs})
        case "clip":
            return Clip(**{"layer": 2, "config": {**CLIP, "image_size": 42}, **settings, **kwargs})
        case "clip16":
            return Clip(**{"variant": "vitb16", "layer": 2, "config": CLIP, **settings, **kwargs})
        case "dino":
            return Dino(**{"layer": 2, "config": CLIP, **settings, **kwargs})
        case "sam":
            return Sam(**{"layer": 2, "config": SAM, **settings, **kwargs})
        case "loftr" | "loftr_fine":
            return LoftrBackbone(**{"level": "fine" if "fine" in name else "coarse", **settings, **kwargs})
        case "s2dnet":
            return S2DNet(**settings, **kwargs)
        case "s2dnet_all":
            return S2DNet(**{"layers": ["conv1_2", "conv3_3", "conv5_3"], **settings, **kwargs})
    raise KeyError(name)


TRANSFORMERS = ["dino", "dinov3", "clip", "clip16", "sam"]
ALL = [*TRANSFORMERS, "loftr", "loftr_fine", "s2dnet", "s2dnet_all"]


def shake(extractor: PretrainedExtractor, seed: int = 1) -> PretrainedExtractor:
    """Move all weights a little: random initialisation has exact zeros, which hide mistakes and stop gradients."""
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in extractor.parameters():
            p.add_(0.02 * torch.randn(p.shape, generator=g, dtype=p.dtype))
    return extractor

"""Patch descriptors of LoFTR's convolutional backbone through kornia."""

from pathlib import Path

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchFeatures
from foundpose.features.pretrained import PretrainedExtractor, check_precision
from foundpose.features.resample import sample_cells
from foundpose.features.weights import WeightsNotFoundError, check_seed, load_state, read_checkpoint

VARIANTS = ("outdoor", "indoor", "indoor_new")
_FILES = {
    "outdoor": "loftr_outdoor.ckpt",
    "indoor": "loftr_indoor.ckpt",
    "indoor_new": "loftr_indoor_ds_new.ckpt",
}
_LEVELS = {"coarse": (256, 8), "fine": (128, 2)}  # channels, pixels from cell to cell
# What the coarse map needs of the backbone, in the order in which it is run.
_COARSE = ("conv1", "bn1", "relu", "layer1", "layer2", "layer3", "layer3_outconv")


class LoftrBackbone(PretrainedExtractor):
    """Patch descriptors from the backbone of LoFTR, a residual network with a feature pyramid on grey images.

    The map is the backbone's own output, without the position encoding and the transformer behind it. Cell k of
    it is centred on pixel ``8 k`` (coarse) or ``2 k`` (fine), since every layer with a stride has a kernel centred
    on the even pixels; it is sampled at the centres of the grid's patches. There is no global descriptor.

    Args:
        variant: training set of the weights: ``outdoor``, ``indoor`` or ``indoor_new``.
        level: ``coarse``, the last layer, of 1/8 resolution and 256 channels; ``fine``, 1/2 and 128.
        weights: ``"hub"`` (kornia's download or its cache), a checkpoint file (``loftr_outdoor.ckpt``), or
            ``"random"`` (with ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown variant, level or precision; a file with other weights.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: "Ablation experiments" of the paper; Sun et al., "LoFTR: Detector-Free Local Feature Matching with
    Transformers", 2021.
    """

    def __init__(
        self,
        variant: str = "outdoor",
        level: str = "coarse",
        weights: str | Path = "hub",
        precision: str | None = None,
        seed: int | None = None,
        compile: bool = False,
    ) -> None:
        if variant not in VARIANTS:
            raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {variant!r}")
        if level not in _LEVELS:
            raise ValueError(f"level must be one of {', '.join(_LEVELS)}, got {level!r}")
        check_precision(precision)
        check_seed(weights, seed)
        backbone = _backbone(variant, weights, seed)
        if level == "coarse":  # the way up the pyramid is needed for the fine map only
            model: nn.Module = nn.Sequential(*(backbone.get_submodule(name) for name in _COARSE))
        else:
            model = backbone
        channels, map_stride = _LEVELS[level]
        settings: Fingerprint = {"variant": variant, "level": level}
        # grey values of 0..1 go in as they are
        super().__init__(
            model, channels, settings, False, precision, mean=(0, 0, 0), std=(1, 1, 1), compile=compile
        )
        self.level = level
        self.map_stride = map_stride

    def input_size(self, image_size: int) -> int:
        """The images' own size."""
        return image_size

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """The backbone's map at the patch centres."""
        found = self.model(rgb_to_grayscale(pixels))
        features = found if self.level == "coarse" else found[1]
        features = features.to(torch.promote_types(features.dtype, torch.float32))
        centers = self.patch_grid(pixels.shape[-1]).centers(pixels.device, features.dtype)
        return PatchFeatures(sample_cells(features, centers, self.map_stride, 0), None)


def how_to_get_weights(variant: str) -> str:
    """Instructions for people, for error messages."""
    name = _FILES[variant]
    return (
        f"To get the weights of LoFTR ({variant}), on a machine with a network run\n"
        f"  hf download kornia/loftr {name} --local-dir DIR\n"
        f"and pass weights=DIR/{name}"
    )


def _backbone(variant: str, weights: str | Path, seed: int | None) -> nn.Module:
    from kornia.feature import LoFTR

    if weights == "hub":
        try:
            return LoFTR(pretrained=variant).get_submodule("backbone")
        except (OSError, RuntimeError) as error:
            raise WeightsNotFoundError(
                f"could not fetch the weights of LoFTR: {error}\n{how_to_get_weights(variant)}"
            ) from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed or 0)
        backbone = LoFTR(pretrained=None).get_submodule("backbone")
    if seed is None:
        how = how_to_get_weights(variant)
        checkpoint = read_checkpoint(Path(weights), how)
        state = checkpoint.get("state_dict", checkpoint)
        # the authors' own checkpoints have "matcher." before every name
        names = {key: key.removeprefix("matcher.").removeprefix("backbone.") for key in state}
        load_state(backbone, {names[key]: value for key, value in state.items()}, Path(weights), how)
    return backbone

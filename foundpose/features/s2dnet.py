"""Patch descriptors of S2DNet: a VGG-16 with adaptation layers."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchFeatures
from foundpose.features.pretrained import PATCH_SIZE, PretrainedExtractor, check_precision
from foundpose.features.resample import on_grid
from foundpose.features.weights import check_seed, load_state, read_checkpoint

_CHANNELS = 128
_CELL = 16  # pixels between the cells of the deepest map
# VGG-16's convolutions, each with a ReLU behind it; 0 is a pooling layer. Together they number as in torchvision.
_VGG16 = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)
# Where the published weights have adaptation layers, in their order: the convolution's number in the encoder.
LAYERS = {"conv1_2": 2, "conv3_3": 14, "conv5_3": 28}
_HOW = (
    "To get the weights of S2DNet, on a machine with a network download\n"
    "  https://www.dropbox.com/s/hnv51iwu4hn82rj/s2dnet_weights.pth?dl=1\n"
    "and pass weights=/path/to/s2dnet_weights.pth"
)


class S2DNet(PretrainedExtractor):
    """Patch descriptors from S2DNet, 128 channels per layer, concatenated.

    A crop is enlarged by 16/14 (420 px to 480 px), so that the cells of ``conv5_3`` are the patches of the grid;
    the finer maps are sampled at the patch centres. There is no global descriptor.

    Args:
        layers: any of ``conv1_2``, ``conv3_3``, ``conv5_3``; the paper takes the last.
        weights: the published ``s2dnet_weights.pth``, or ``"random"`` (with ``seed``; for tests and dry runs).
        precision: ``"bf16"`` or ``"fp16"`` runs the model under autocast, ``"auto"`` in what the device gains from
            (in inference only); None in the weights' own precision.
        seed: of random weights, and only of these.
        compile: compile the model, see ``PretrainedExtractor``.

    Raises:
        ValueError: unknown layer or precision; a file with other weights.
        WeightsNotFoundError: no weights; the message says how to get them.

    Source: "Ablation experiments" of the paper; Germain et al., "S2DNet: Learning Image Features for Accurate
    Sparse-to-Dense Matching", 2020.
    """

    def __init__(
        self,
        layers: Sequence[str] = ("conv5_3",),
        weights: str | Path = "s2dnet_weights.pth",
        precision: str | None = None,
        seed: int | None = None,
        compile: bool = False,
    ) -> None:
        unknown = [name for name in layers if name not in LAYERS]
        if not layers or unknown or len(set(layers)) < len(layers):
            raise ValueError(
                f"layers must be one or more different of {', '.join(LAYERS)}, got {list(layers)}"
            )
        check_precision(precision)
        check_seed(weights, seed)
        ordered = [name for name in LAYERS if name in layers]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed or 0)
            network = HypercolumnNetwork(ordered)
        if seed is None:
            checkpoint = read_checkpoint(Path(weights), _HOW)
            load_state(network, checkpoint.get("state_dict", checkpoint), Path(weights), _HOW)
        settings: Fingerprint = {"layers": " ".join(ordered)}
        super().__init__(
            network, _CHANNELS * len(ordered), settings, has_cls=False, precision=precision, compile=compile
        )

    def input_size(self, image_size: int) -> int:
        """16 px per patch of the grid."""
        return image_size // PATCH_SIZE * _CELL

    def describe(self, pixels: Tensor) -> PatchFeatures:
        """The maps at the patch centres."""
        n = pixels.shape[-1] // _CELL
        return PatchFeatures(torch.cat([on_grid(m, n) for m in self.model(pixels)], dim=1), None)


class HypercolumnNetwork(nn.Module):
    """VGG-16 up to the deepest layer asked for, and an adaptation layer for each, named as in the published weights.

    Args:
        layers: names of ``LAYERS``, in its order.
    """

    def __init__(self, layers: Sequence[str]) -> None:
        super().__init__()
        self.taps = [LAYERS[name] for name in layers]
        self.encoder = vgg16_encoder(self.taps[-1] + 1)
        adaptations = {}
        for number, (name, tap) in enumerate(LAYERS.items()):
            if name in layers:
                channels = self.encoder.get_parameter(f"{tap}.weight").shape[0]
                adaptations[f"adap_layer_{number}"] = adaptation_layer(channels)
        self.adaptation_layers = nn.ModuleDict(adaptations)

    def forward(self, pixels: Tensor) -> list[Tensor]:
        """Adapted maps (B, 128, s / k, s / k) of pixels (B, 3, s, s), k = 1, 4 and 16 for the three layers."""
        found = []
        features = pixels
        for number, layer in enumerate(self.encoder):
            features = layer(features)
            if number in self.taps:
                # The network was trained with rectification in place, which reaches the maps taken before it; the
                # deepest, at the end of the encoder, has none behind it.
                found.append(features if number == LAYERS["conv5_3"] else features.relu())
        return [adapt(m) for adapt, m in zip(self.adaptation_layers.values(), found, strict=True)]


def vgg16_encoder(length: int) -> nn.Sequential:
    """The first layers of VGG-16's convolutional part, numbered as in torchvision's ``features``."""
    layers: list[nn.Module] = []
    channels = 3
    for width in _VGG16:
        if width == 0:
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
        channels = width
    for layer in layers:
        if isinstance(layer, nn.Conv2d):  # keeps the scale of random features through 13 layers
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers[:length])


def adaptation_layer(channels: int) -> nn.Sequential:
    """Maps (B, channels, h, w) to (B, 128, h, w)."""
    return nn.Sequential(
        nn.Conv2d(channels, 64, 1),
        nn.ReLU(),
        nn.Conv2d(64, _CHANNELS, 5, padding=2),
        nn.BatchNorm2d(_CHANNELS),
    )

"""MegaPose's networks: a ResNet-34 that sees crop and renderings, with the names of the published checkpoints."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from foundpose.features.weights import WeightsNotFoundError, check_seed, load_state, read_checkpoint
from foundpose.refinement.pose_update import IDENTITY_UPDATE, UPDATE_SIZE
from foundpose.utils.files import save_weights

Head = Literal["pose", "score"]

_RUNS: dict[Head, str] = {"pose": "refiner-rgb-653307694", "score": "coarse-rgb-906902141"}
_BLOCKS = (3, 4, 6, 3)  # ResNet-34's
_CHECKPOINT = "checkpoint.pth.tar"
_FILES = (_CHECKPOINT, "model.safetensors", "pytorch_model.bin")
# What an output of one unit means: a quarter in a column of a rotation, 16 pixels, an eighth of the depth.
_UNITS = (0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 16.0, 16.0, 0.125)
# Beginnings of keys in older checkpoints, and what they are called now.
_OLDER = {"backbone.backbone.": "backbone.", "backbone.head.0.": "views_logits_head."}


class MegaPoseNetwork(nn.Module):
    """Sees a crop and renderings of an object; says how its pose should move, or how well it fits.

    Args:
        head: "pose" for the refiner's network, "score" for the coarse one.
        views: renderings beside the crop; the published refiner has 4, the published coarse network 1.
        width: channels of the first convolution; the others have up to eight times as many. 64 is the published one.
        weights: run folder, checkpoint file, folder with ``model.safetensors``, or folder with run folders;
            "random" for an untrained network, which moves nothing.
        seed: of random weights.

    Raises:
        WeightsNotFoundError: nothing there; the message says how to get the published ones.
        ValueError: weights of another network, or a setting out of range.

    Source: Labbé et al., "MegaPose", CoRL 2022; He et al., "Deep Residual Learning", CVPR 2016.
    """

    def __init__(
        self,
        head: Head,
        views: int,
        width: int = 64,
        weights: str | Path = "random",
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if head not in _RUNS or views < 1 or width < 1:
            raise ValueError(
                f"head must be pose or score, views and width at least 1, got {head!r}, {views} and {width}"
            )
        check_seed(weights, seed)
        self.head: Head = head
        self.views = views
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0 if seed is None else seed)
            self.backbone = _ResNet34(3 + 6 * views, width)
            if head == "pose":
                self.pose_fc = _PoseHead(8 * width, UPDATE_SIZE)
            else:
                self.views_logits_head = nn.Linear(8 * width, 1)
        if weights != "random":
            path = _find(Path(weights), head)
            load_state(self, _read(path, head), path, how_to_get_weights(head))

    def forward(self, pictures: Tensor) -> Tensor:
        """Predict.

        Args:
            pictures: (M, 3 + 6 · views, H, W) in [0, 1]: the crop's RGB, then of each view RGB and normals as colours
                (:func:`foundpose.refinement.megapose.normal_colors`).

        Returns:
            (M, 9) updates as :func:`foundpose.refinement.apply_update` takes them, or (M, 1) logits.

        Raises:
            ValueError: another number of channels.

        Differentiable w.r.t. ``pictures`` and the parameters.
        """
        channels = 3 + 6 * self.views
        if pictures.dim() != 4 or pictures.shape[1] != channels:
            raise ValueError(f"pictures must have shape (M, {channels}, H, W), got {tuple(pictures.shape)}")
        features = self.backbone(pictures)
        if self.head == "score":
            return self.views_logits_head(features)
        # The published order is the rotation first.
        return self.pose_fc(features).roll(3, dims=-1)

    def save(self, path: str | Path) -> None:
        """Write the weights as a safetensors file, whole or not at all; ``weights`` takes it."""
        save_weights(Path(path), self, "megapose_network", {"head": self.head, "views": self.views})


class _PoseHead(nn.Linear):
    """A linear layer whose parameters are trained in units of its outputs; at first it moves nothing.

    An optimiser that takes steps of one size would else learn pixels slowly and rotations wildly. State dictionaries
    hold the plain weights; the units are powers of two, so no digit is lost.
    """

    units: Tensor

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        self.register_buffer("units", torch.tensor(_UNITS), persistent=False)
        nn.init.zeros_(self.weight)
        with torch.no_grad():
            self.bias.copy_(torch.tensor(IDENTITY_UPDATE).roll(-3) / self.units)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * self.units

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        destination[f"{prefix}weight"] = destination[f"{prefix}weight"] * self.units[:, None]
        destination[f"{prefix}bias"] = destination[f"{prefix}bias"] * self.units

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *arguments: Any) -> None:
        units = {f"{prefix}weight": self.units[:, None], f"{prefix}bias": self.units}
        mine = {name: value / units[name].to(value) for name, value in state_dict.items() if name in units}
        super()._load_from_state_dict({**state_dict, **mine}, prefix, *arguments)


class _Block(nn.Module):
    """Two 3 × 3 convolutions and a shortcut."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels:
            projection = nn.Conv2d(channels_in, channels, 1, stride=stride, bias=False)
            self.downsample = nn.Sequential(projection, nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        residual = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(residual + self.downsample(x))


class _ResNet34(nn.Module):
    """From pictures to features (M, 8 · width)."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        inputs = width
        for number, count in enumerate(_BLOCKS):
            outputs = width * 2**number
            first = _Block(inputs, outputs, 1 if number == 0 else 2)
            others = [_Block(outputs, outputs, 1) for _ in range(count - 1)]
            self.add_module(f"layer{number + 1}", nn.Sequential(first, *others))
            inputs = outputs
        self.fc = nn.Linear(inputs, inputs)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, stride=2, padding=1)
        for number in range(len(_BLOCKS)):
            x = self.get_submodule(f"layer{number + 1}")(x)
        return self.fc(x.mean(dim=(2, 3)))


def how_to_get_weights(head: Head) -> str:
    """Instructions for people, for error messages."""
    run = _RUNS[head]
    return (
        f"The published network is the run {run}: clone https://github.com/megapose6d/megapose6d, run\n"
        "  rclone copyto megapose_public_readonly:/megapose-models megapose-models "
        '--exclude="**epoch**" --config megapose6d/rclone.conf\n'
        f"and pass weights=megapose-models/{run}"
    )


def _find(path: Path, head: Head) -> Path:
    """The file with the weights at a path."""
    for folder in (path, path / _RUNS[head]):
        for name in _FILES:
            if (folder / name).is_file():
                return folder / name
    return path / _CHECKPOINT if path.is_dir() else path


def _read(path: Path, head: Head) -> Mapping[str, Tensor]:
    """State of a file under the names of today."""
    how = how_to_get_weights(head)
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise WeightsNotFoundError(f"no weights at {path}.\n{how}")
        state: Mapping[str, Tensor] = load_file(path)
    else:
        checkpoint = read_checkpoint(path, how)
        state = checkpoint.get("state_dict", checkpoint)

    def rename(key: str) -> str:
        for older, newer in _OLDER.items():
            if key.startswith(older):
                return newer + key.removeprefix(older)
        return key

    return {rename(key): value for key, value in state.items()}

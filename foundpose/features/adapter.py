"""A small trained layer on the descriptors of an extractor."""

import hashlib
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.utils.files import check_weights, read_weights, save_weights

SCHEMA_VERSION = 1
_HEADER = "foundpose_adapter"


class ResidualAdapter(nn.Module):
    """Turns the direction of each descriptor by a small residual network and keeps its length.

    ``y = x + |x| g(x / |x|)``, rescaled to the length of x, with g two linear layers and a GELU between them. It is
    the identity, bit by bit, before it is trained, and it commutes with the scale of the descriptors: what is set
    in their unit (the σ of soft assignment, a matching temperature) stays right.

    Args:
        channels: length C of a descriptor.
        hidden: width of the layer between.
        seed: of the first layer's random weights; the last layer's are zero.

    Raises:
        ValueError: a size below 1.
    """

    def __init__(self, channels: int, hidden: int = 256, seed: int = 0) -> None:
        super().__init__()
        if channels < 1 or hidden < 1:
            raise ValueError(f"channels and hidden must be at least 1, got {channels} and {hidden}")
        self.channels = channels
        self.hidden = hidden
        self.inner = nn.Linear(channels, hidden)
        self.outer = nn.Linear(hidden, channels)
        # Of its own, so that equal settings make equal adapters whatever was drawn before.
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            self.inner.weight.normal_(0.0, channels**-0.5, generator=generator)
        for zero in (self.inner.bias, self.outer.weight, self.outer.bias):
            nn.init.zeros_(zero)

    def forward(self, descriptors: Tensor) -> Tensor:
        """Adapt descriptors (..., C); the result has their shape, dtype and lengths. Zero stays zero.

        Raises:
            ValueError: another number of channels.

        Differentiable w.r.t. ``descriptors`` and the parameters; a descriptor of zero has gradient zero.
        """
        if descriptors.dim() < 1 or descriptors.shape[-1] != self.channels:
            raise ValueError(
                f"descriptors must have shape (..., {self.channels}), got {tuple(descriptors.shape)}"
            )
        weight = self.inner.weight
        x = descriptors.to(torch.promote_types(descriptors.dtype, weight.dtype))
        length, divisor = _length(x)
        turned = x + self._branch((x / divisor).to(weight.dtype)).to(x.dtype) * length
        return (turned * (length / _length(turned)[1])).to(descriptors.dtype)

    def _branch(self, direction: Tensor) -> Tensor:
        """g of directions (..., C) of root mean square one."""
        return self.outer(F.gelu(self.inner(direction)))

    def checksum(self) -> str:
        """Of all weights."""
        digest = hashlib.sha256()
        for name, value in sorted(self.state_dict().items()):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()[:16]

    def save(self, path: str | Path) -> None:
        """Write settings and weights as one safetensors file, whole or not at all."""
        facts = {"schema_version": SCHEMA_VERSION, "channels": self.channels, "hidden": self.hidden}
        save_weights(Path(path), self, _HEADER, facts)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an adapter from a file written by :meth:`save`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: no adapter's file, one of another schema version, or one whose weights are damaged.
        """
        path = Path(path)
        hint = "train one with experiments/train_adapter.py"
        facts, tensors = read_weights(path, _HEADER, SCHEMA_VERSION, "adapter", hint)
        adapter = cls(facts["channels"], facts["hidden"])
        check_weights(path, tensors, adapter)
        adapter.to(tensors["inner.weight"].dtype).load_state_dict(tensors)
        return adapter

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"channels={self.channels}, hidden={self.hidden}"


class AdaptedExtractor(PatchExtractor):
    """Another extractor with an adapter on its patch descriptors; the global descriptor stays as it is.

    Onboard objects with it: templates and crops must be adapted alike, and the fingerprint sees to that.

    Args:
        extractor: the extractor to adapt. To train the adapter alone, freeze it with ``requires_grad_(False)``.
        adapter: the adapter; None for a new one, which changes nothing.
        weights: file of a trained adapter, in place of ``adapter``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: both an adapter and a file, no adapter's file, or an adapter for another number of channels.
    """

    def __init__(
        self,
        extractor: PatchExtractor,
        adapter: ResidualAdapter | None = None,
        weights: str | Path | None = None,
    ) -> None:
        super().__init__(extractor.channels, extractor.stride, extractor.offset)
        if adapter is not None and weights is not None:
            raise ValueError("give either an adapter or the weights of one, not both")
        if weights is not None:
            adapter = ResidualAdapter.load(weights)
        if adapter is None:
            adapter = ResidualAdapter(extractor.channels)
        if adapter.channels != extractor.channels:
            raise ValueError(
                f"the adapter{'' if weights is None else f' in {weights}'} is for descriptors of "
                f"{adapter.channels} channels, the extractor's have {extractor.channels}"
            )
        self.extractor = extractor
        self.adapter = adapter
        self.leaves_border = extractor.leaves_border

    def forward(self, images: Tensor, border: int = 0) -> PatchFeatures:
        """Describe the patches of RGB images (B, 3, S, S) with values in [0, 1], but for a border where asked to.

        Differentiable w.r.t. the adapter's parameters and whatever the inner extractor is differentiable w.r.t.
        """
        features = self.extractor.within(images, border)
        patches = self.adapter(features.patches.movedim(1, -1)).movedim(-1, 1)
        return features._replace(patches=patches)

    def running_precision(self) -> str | None:
        """The inner extractor's."""
        return self.extractor.running_precision()

    def fingerprint(self) -> Fingerprint:
        """The inner extractor's, the adapter's architecture and a checksum of its weights."""
        return self.extractor.fingerprint() | {
            "adapter": type(self.adapter).__name__,
            "adapter_hidden": self.adapter.hidden,
            "adapter_weights": self.adapter.checksum(),
        }


def _length(x: Tensor) -> tuple[Tensor, Tensor]:
    """Root mean squares (..., 1) of vectors (..., C), and what to divide by: the same, but 1 for zero vectors."""
    squared = x.square().mean(-1, keepdim=True)
    divisor = torch.where(squared > 0, squared, torch.ones_like(squared)).sqrt()
    return torch.where(squared > 0, divisor, torch.zeros_like(squared)), divisor

"""What the extractors that run a pretrained network have in common."""

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.features.checks import check_images
from foundpose.features.precision import (
    autocast_dtype,
    autocast_precision,
    check_precision,
    quantize_linear_layers,
)
from foundpose.features.resample import on_grid, resize_images
from foundpose.features.weights import weights_checksum

PATCH_SIZE = 14
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CPU_PIXELS = 2 * 420**2
"""Pixels that a CPU runs the network on at a time: what lies between the layers then fits its cache."""


class CompilationError(ValueError):
    """``torch.compile`` does not work on this machine; the message says what it needs."""


class PretrainedExtractor(PatchExtractor):
    """Runs a network and puts its features on the grid of 14 px patches: 30 × 30 for a crop of 420 px.

    The crop is resized to the side that suits the network (``input_size``), its values are normalised, and the
    network's feature map is sampled at the patch centres where its own grid is another one. The network stays in
    evaluation mode, also where the extractor is part of a model in training: batch statistics and random
    augmentations of positions would make a descriptor depend on its neighbours in the batch.

    Args:
        model: the network.
        channels: length C of a descriptor.
        settings: what the fingerprint says besides the weights.
        has_cls: whether ``describe`` gives a global descriptor.
        precision: ``"bf16"`` or ``"fp16"`` runs the network under autocast, ``"auto"`` under the type that the device
            gains from and without gradients only (:func:`foundpose.features.precision.autocast_dtype`), ``"int8"``
            its linear layers in 8-bit integers, on a CPU and without gradients only, None in the weights' own
            precision.
        mean: of the network's training images, per channel, for values in [0, 1].
        std: their standard deviation.
        compile: compile the network with ``torch.compile``, anew for each size and number of images (which takes half
            a minute or more), so give it batches of few different lengths: beyond eight PyTorch goes back to running
            the network as it is. A copy or an unpickled extractor compiles again.

    Raises:
        ValueError: unknown precision; "int8" with ``compile``, or (on a call) with a network that is not on a CPU.
        CompilationError: (on a call) ``compile`` where there is no compiler.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        model: nn.Module,
        channels: int,
        settings: Fingerprint,
        has_cls: bool,
        precision: str | None,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        compile: bool = False,
    ) -> None:
        check_precision(precision)
        if compile and precision == "int8":
            raise ValueError("precision 'int8' cannot be compiled; set compile=false, or another precision")
        super().__init__(channels, stride=PATCH_SIZE, offset=(PATCH_SIZE - 1) / 2)
        self.model = model.eval()
        self.settings = dict(settings)
        self.has_cls = has_cls
        self.precision = precision
        self.compiled = compile
        self._compiled: Callable[[Tensor, int], PatchFeatures] | None = None
        self._at_once: int | None = None  # images on a CPU; None: as many as fit its cache
        self._int8: tuple[tuple[object, ...], Self] | None = None  # not a submodule: its weights are these
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(3, 1, 1), persistent=False)

    @abstractmethod
    def input_size(self, image_size: int) -> int:
        """Side in pixels that images of ``image_size`` px are resized to for the network."""

    @abstractmethod
    def describe(self, pixels: Tensor) -> PatchFeatures:
        """Run the network.

        Args:
            pixels: (B, 3, s, s) normalised RGB, s = ``input_size``, in the dtype of the weights.

        Returns:
            Features (B, C, m, m) whose cells tile the image, or (B, C, S/14, S/14) on the grid already, and the
            global descriptor (B, C) or None.
        """

    def describe_within(self, pixels: Tensor, border: int) -> PatchFeatures:
        """What :meth:`describe` returns, with the outer ``border`` rows and columns left out: they are zero."""
        raise ValueError(f"{type(self).__name__} cannot leave out patches; border must be 0, got {border}")

    def forward(self, images: Tensor, border: int = 0) -> PatchFeatures:
        """Describe the patches of images.

        Args:
            images: (B, 3, S, S) RGB in [0, 1]; S a multiple of 14 px.
            border: rows and columns of patches along each edge to leave out; only where ``leaves_border``.

        Returns:
            Patch descriptors (B, C, S/14, S/14) and the global descriptor (B, C) or None, in the dtype of
            ``images``.

        Raises:
            ValueError: wrong shape, type, size or range of ``images``, or a ``border`` that leaves nothing.

        Differentiable w.r.t. ``images`` and the parameters.
        """
        if self.precision == "int8" and not torch.is_grad_enabled():
            return self._in_int8().forward(images, border)  # hooks of this module are called once
        check_images(images, multiple_of=PATCH_SIZE)
        size = images.shape[-1]
        n = size // PATCH_SIZE
        if border and not 0 < 2 * border < n:
            raise ValueError(f"border must leave some of the {n} × {n} patches, got {border}")
        if not len(images):  # transformers' attention cannot reshape an empty batch
            cls = images.new_zeros(0, self.channels) if self.has_cls else None
            return PatchFeatures(images.new_zeros(0, self.channels, n, n), cls)
        # resized and normalised in at least single precision
        dtype = torch.promote_types(torch.promote_types(images.dtype, self.mean.dtype), torch.float32)
        pixels = images.to(dtype)
        pixels = (resize_images(pixels, self.input_size(size)) - self.mean) / self.std
        pixels = pixels.to(next(self.model.parameters()).dtype)
        autocast = autocast_dtype(self.precision, images.device)
        with torch.autocast(images.device.type, dtype=autocast, enabled=autocast is not None):
            patches, cls = (self._run_compiled if self.compiled else self._run_in_parts)(pixels, border)
        cls = None if cls is None else cls.to(images.dtype)
        return PatchFeatures(on_grid(patches, n).to(images.dtype), cls)

    def _in_int8(self) -> Self:
        """A copy that multiplies 8-bit integers, of the weights as they are now."""
        weights = list(self.model.parameters())
        if weights[0].device.type != "cpu":
            raise ValueError(
                f"precision 'int8' is for CPUs, the network is on {weights[0].device}; use 'auto'"
            )
        state = (id(self.model), *((w.dtype, 0 if w.is_inference() else w._version) for w in weights))
        if self._int8 is None or self._int8[0] != state:
            quantized = copy.deepcopy(self)
            # Scales are of all that is multiplied at once: a descriptor must not depend on other images.
            quantized.precision, quantized._at_once = None, 1
            quantize_linear_layers(quantized.model)
            self._int8 = state, quantized
        return self._int8[1]

    def _run_in_parts(self, pixels: Tensor, border: int) -> PatchFeatures:
        count = self._at_once or max(1, CPU_PIXELS // pixels[0, 0].numel())
        if pixels.device.type != "cpu" or len(pixels) <= count:
            return self._run(pixels, border)
        patches, cls = zip(*(self._run(part, border) for part in pixels.split(count)), strict=True)
        return PatchFeatures(torch.cat(patches), torch.cat(cls) if self.has_cls else None)

    def _run(self, pixels: Tensor, border: int) -> PatchFeatures:
        return self.describe_within(pixels, border) if border else self.describe(pixels)

    def _run_compiled(self, pixels: Tensor, border: int) -> PatchFeatures:
        """The same, compiled on the first call."""
        from torch._dynamo.exc import TorchDynamoException

        if self._compiled is None:
            self._compiled = torch.compile(self._run, dynamic=False)
        try:
            return self._compiled(pixels, border)
        except TorchDynamoException as error:
            raise CompilationError(
                f"torch.compile failed ({str(error).strip().splitlines()[0]}); on a CPU it needs a C++ compiler (g++ "
                "or clang), on a GPU triton and a C compiler. Set compile=false to do without"
            ) from error

    def __getstate__(self) -> dict[str, Any]:
        # What is compiled runs the weights of the extractor that it was compiled for.
        return {**cast(dict[str, Any], super().__getstate__()), "_compiled": None, "_int8": None}

    def running_precision(self) -> str | None:
        """ "bf16", "fp16" or "int8" where inference does, with "auto" resolved for the network's device."""
        return autocast_precision(self.precision, self.mean.device)

    def fingerprint(self) -> Fingerprint:
        """The settings and a checksum of the weights as they are now; not the precision.

        Casting the weights (``half()``) changes their values and so the checksum; ``precision`` does not.
        """
        return {
            "extractor": type(self).__name__,
            **self.settings,
            "weights": weights_checksum(self.model),
        }

    def train(self, mode: bool = True) -> Self:
        """Set the mode of training of everything but the network, which stays in evaluation mode."""
        super().train(mode)
        self.model.eval()
        return self

    def extra_repr(self) -> str:
        """Shown by ``print``."""
        shown = {**self.settings, "precision": self.precision, "compile": self.compiled}
        return ", ".join(f"{k}={v!r}" for k, v in shown.items())

"""Extractors for experiments without a backbone: a code of true coordinates, and noise."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures

# Colours of the surface, see foundpose.rendering.coordinates; features/ does not import rendering/.
_COLOR_CENTRE, _COLOR_RANGE, _DARKEST = 0.5, 0.8, 0.05


class CoordinateCode(PatchExtractor):
    """Smooth random-Fourier code of the model coordinate that a patch's centre shows.

    Works on pictures whose colours are coordinates (:class:`foundpose.rendering.CoordinateRenderer`), for
    templates and queries alike. So everything but the backbone is tested on real geometry, occlusion included.
    A patch that shows no object gets a random code, which depends on its place and the seed alone.

    Args:
        channels: number of features.
        wavelength: mean wavelength of the code in diameters.
        norm: expected norm of a descriptor; 40 is about that of DINOv2's patch tokens.
        stride: distance of patch centres in pixels.
        offset: coordinate of the first patch centre in pixels.
        seed: of frequencies, phases and random codes.
    """

    directions: Tensor
    phases: Tensor
    background: Tensor

    def __init__(
        self,
        channels: int = 256,
        wavelength: float = 1.0,
        norm: float = 40.0,
        stride: float = 14.0,
        offset: float = 6.5,
        seed: int = 0,
    ) -> None:
        super().__init__(channels, stride, offset)
        self.wavelength = wavelength
        self.norm = norm
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        directions = F.normalize(torch.randn(3, channels, generator=generator), dim=0)
        # Wavelengths between 2/3 and 2 of the mean, evenly in frequency.
        frequency = (0.5 + torch.rand(channels, generator=generator)) / wavelength
        self.register_buffer("directions", directions * frequency * (2.0 * math.pi))
        self.register_buffer("phases", torch.rand(channels, generator=generator) * (2.0 * math.pi))
        self.register_buffer("background", torch.randn(4096, channels, generator=generator))

    def forward(self, images: Tensor) -> PatchFeatures:
        """Describe coordinate pictures (B, 3, S, S). Differentiable w.r.t. ``images`` on the object."""
        if images.dim() != 4 or images.shape[1] != 3 or images.shape[2] != images.shape[3]:
            raise ValueError(f"images must have shape (B, 3, S, S), got {tuple(images.shape)}")
        size = images.shape[-1]
        centres = self.patch_grid(size).centers(images.device, images.dtype)
        sampling = ((2 * centres + 1) / size - 1).expand(len(images), -1, -1, -1)
        colors = F.grid_sample(images, sampling, align_corners=False).permute(0, 2, 3, 1)
        coordinates = (colors - _COLOR_CENTRE) / _COLOR_RANGE
        angles = coordinates @ self.directions.to(images.dtype) + self.phases.to(images.dtype)
        codes = torch.cos(angles) * (self.norm * math.sqrt(2.0 / self.channels))
        cells = torch.arange(colors.shape[1] * colors.shape[2], device=images.device) % len(self.background)
        random = self.background[cells].to(images.dtype) * (self.norm / math.sqrt(self.channels))
        shows_object = (colors > _DARKEST).all(dim=-1, keepdim=True)
        codes = torch.where(shows_object, codes, random.reshape(*colors.shape[1:3], -1))
        return PatchFeatures(codes.permute(0, 3, 1, 2), None)

    def fingerprint(self) -> Fingerprint:
        """Settings that change the code."""
        return {
            "extractor": "CoordinateCode",
            "channels": self.channels,
            "wavelength": self.wavelength,
            "norm": self.norm,
            "stride": self.stride,
            "offset": self.offset,
            "seed": self.seed,
        }


class PatchNoise(PatchExtractor):
    """Replaces some patches of another extractor by noise, to see what the rest of the method can bear.

    Use it for queries only; its fingerprint is the other extractor's. Which patches are hit and what they become
    depends on the seed and their place alone.

    Args:
        extractor: the extractor to disturb.
        fraction: share of the patches that are replaced, in [0, 1].
        seed: of the places and the noise.
    """

    def __init__(self, extractor: PatchExtractor, fraction: float, seed: int = 0) -> None:
        super().__init__(extractor.channels, extractor.stride, extractor.offset)
        if not 0.0 <= fraction <= 1.0:
            raise ValueError(f"fraction must be in [0, 1], got {fraction}")
        self.extractor = extractor
        self.fraction = fraction
        self.seed = seed

    def forward(self, images: Tensor) -> PatchFeatures:
        """Describe images (B, 3, S, S); noise has the root-mean-square norm of the image's descriptors.

        Differentiable w.r.t. ``images`` and the disturbed extractor's parameters, through the patches that it leaves.
        """
        features = self.extractor(images)
        patches = features.patches
        generator = torch.Generator().manual_seed(self.seed)
        hit = torch.rand(patches.shape[-2:], generator=generator) < self.fraction
        noise = torch.randn(patches.shape[1:], generator=generator).to(patches)
        scale = patches.detach().square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
        return features._replace(patches=torch.where(hit.to(patches.device), noise * scale, patches))

    def running_precision(self) -> str | None:
        """The disturbed extractor's."""
        return self.extractor.running_precision()

    def fingerprint(self) -> Fingerprint:
        """The fingerprint of the disturbed extractor."""
        return self.extractor.fingerprint()

"""SIFT descriptors on a regular grid, at several supports."""

from collections.abc import Sequence
from math import ceil

import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import SIFTDescriptor
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.features.checks import check_images

_CELLS = 4  # a SIFT descriptor has 4 × 4 spatial cells of 8 orientations
_CHANNELS = 8 * _CELLS**2


class DenseSift(PatchExtractor):
    """Upright SIFT descriptors of square windows around the grid's patch centres, one per support, concatenated.

    Needs no weights. The windows are resampled from the image, smoothed in proportion to the support, by one
    gather; nothing is oriented, for templates and crops are compared at the same in-plane rotation. Each support's
    descriptor has unit norm, except that it fades to zero where the window is flat (see ``contrast``).

    Args:
        supports: sides of the windows in pixels.
        stride: distance of neighbouring patch centres in pixels.
        offset: pixel coordinate of the first patch centre; ``(stride - 1) / 2`` tiles the image.
        window_size: samples along one side of a resampled window.
        smoothing: standard deviation of the blur over the support; 1/12 is SIFT's own.
        contrast: standard deviation of grey values (of 0..1) in a window at which its descriptor has half its
            length; keeps noise in flat windows from looking like texture.
        rootsift: take the square root of the L1-normalised descriptor (Hellinger kernel).

    Raises:
        ValueError: a setting out of range.

    Source: Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", 2004; Arandjelović and Zisserman,
    "Three things everyone should know", 2012 (RootSIFT).
    """

    def __init__(
        self,
        supports: Sequence[float] = (28.0, 84.0),
        stride: float = 14.0,
        offset: float = 6.5,
        window_size: int = 16,
        smoothing: float = 1 / 12,
        contrast: float = 0.01,
        rootsift: bool = False,
    ) -> None:
        if not supports or min(supports) <= 0:
            raise ValueError(f"supports must be one or more positive sizes in pixels, got {tuple(supports)}")
        if stride <= 0 or offset < 0:
            raise ValueError(f"stride must be positive and offset not negative, got {stride} and {offset}")
        if window_size < 2 * _CELLS:
            raise ValueError(f"window_size must be at least {2 * _CELLS}, got {window_size}")
        if smoothing < 0 or contrast < 0:
            raise ValueError(f"smoothing and contrast must not be negative, got {smoothing} and {contrast}")
        super().__init__(_CHANNELS * len(supports), stride, offset)
        self.supports = tuple(float(s) for s in supports)
        self.window_size = window_size
        self.smoothing = smoothing
        self.contrast = contrast
        self.rootsift = rootsift
        self.descriptor = SIFTDescriptor(window_size, num_spatial_bins=_CELLS, rootsift=rootsift)
        self.descriptor.requires_grad_(False)

    def forward(self, images: Tensor) -> PatchFeatures:
        """Describe the patches of images.

        Args:
            images: (B, 3, S, S) RGB in [0, 1].

        Returns:
            Patch descriptors (B, 128 * len(supports), h, w) in the dtype of ``images``; no global descriptor.

        Raises:
            ValueError: wrong shape, type, size or range of ``images``.

        Differentiable w.r.t. ``images``.
        """
        check_images(images)
        smallest = ceil(2 * self.offset + 1)
        if images.shape[-1] < smallest:
            raise ValueError(
                f"images of {images.shape[-1]} px have no patch; at least {smallest} px are needed"
            )
        n = self.patch_grid(images.shape[-1]).size
        # half precision loses the small gradients that descriptors are made of
        gray = rgb_to_grayscale(images.to(torch.promote_types(images.dtype, torch.float32)))
        centers = self.patch_grid(images.shape[-1]).centers(images.device, gray.dtype).flatten(0, 1)
        maps = []
        for support in self.supports:
            windows = sample_windows(gray, centers, support, self.window_size, self.smoothing * support)
            described = describe_windows(windows.flatten(0, 1), self.descriptor, self.contrast)
            maps.append(described.unflatten(0, windows.shape[:2]))
        patches = torch.cat(maps, dim=-1).transpose(1, 2).unflatten(2, (n, n))
        return PatchFeatures(patches.to(images.dtype), None)

    def fingerprint(self) -> Fingerprint:
        """All settings: every one of them changes the descriptors."""
        return {
            "extractor": "DenseSift",
            "supports": " ".join(f"{s:g}" for s in self.supports),
            "stride": float(self.stride),
            "offset": float(self.offset),
            "window_size": self.window_size,
            "smoothing": self.smoothing,
            "contrast": self.contrast,
            "rootsift": self.rootsift,
        }

    def extra_repr(self) -> str:
        """Shown by ``print``."""
        return ", ".join(f"{k}={v!r}" for k, v in self.fingerprint().items() if k != "extractor")


def sample_windows(gray: Tensor, centers: Tensor, support: float, size: int, sigma: float) -> Tensor:
    """Resample square windows of an image.

    Args:
        gray: (B, 1, H, W).
        centers: (N, 2) centres as ``(u, v)`` pixels.
        support: side of a window in pixels.
        size: samples along a side; sample k lies at ``(k + 0.5) / size`` of it.
        sigma: standard deviation in pixels of the Gaussian blur before sampling.

    Returns:
        (B, N, size, size). Beyond the image's border its outermost pixels are repeated.

    Differentiable w.r.t. ``gray``.
    """
    height, width = gray.shape[-2:]
    if sigma > 0:
        # replicated: a reflecting border cannot be wider than the image, and a black one would be an edge
        kernel = 2 * ceil(3 * sigma) + 1
        sigmas = torch.full((1, 2), sigma, device=gray.device, dtype=gray.dtype)
        gray = gaussian_blur2d(gray, (kernel, kernel), sigmas, border_type="replicate")
    steps = (torch.arange(size, device=gray.device, dtype=gray.dtype) + 0.5) / size * support - support / 2
    u = (centers[:, 0, None] + steps)[:, None, :].expand(-1, size, -1)
    v = (centers[:, 1, None] + steps)[:, :, None].expand(-1, -1, size)
    grid = torch.stack([(2 * u + 1) / width - 1, (2 * v + 1) / height - 1], dim=-1)
    sampled = nn.functional.grid_sample(
        gray,
        grid.flatten(0, 1).expand(gray.shape[0], -1, -1, -1),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return sampled.unflatten(2, (-1, size)).squeeze(1)


def describe_windows(windows: Tensor, descriptor: nn.Module, contrast: float) -> Tensor:
    """SIFT descriptors that fade to zero with the contrast of the window.

    Args:
        windows: (N, p, p) grey values.
        descriptor: kornia's ``SIFTDescriptor`` for p × p windows.
        contrast: standard deviation at which a descriptor has half its length; 0 for none.

    Returns:
        (N, 128). Differentiable w.r.t. ``windows``; the gradient of a flat window is zero. With a contrast of 0
        the gradient of a nearly flat window is finite but grows as the window's contrast falls.
    """
    described = descriptor(windows.unsqueeze(1))
    centred = windows - windows.mean(dim=(-2, -1), keepdim=True)
    variance = centred.square().mean(dim=(-2, -1)).unsqueeze(-1)
    if contrast == 0:
        return described
    return described * (variance / (variance + contrast**2))

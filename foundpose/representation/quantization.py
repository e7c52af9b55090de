"""How patch descriptors are kept: as they are, in half precision, or as codes of a byte each."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.clustering.kmeans import kmeans

Storage = Literal["float32", "float16", "int8", "pq"]

_LEVELS = 256
_ROWS_PER_BLOCK = 8192
# Scores of a block of descriptors against all centroids: they fit the processor's cache.
_SCORES_PER_BLOCK = 1 << 22
# Scales and centroids are fitted to so many descriptors, drawn at random.
_ROWS_FOR_SCALES = 32768
_ROWS_PER_CENTROID = 32
# Further iterations and samples lower the error by less than 2 %.
_KMEANS_ITERATIONS = 8
# What a channel's range may be cut to: outliers are clipped where that makes the rest more exact.
_RANGES = tuple(2.0 ** (-i / 4) for i in range(9))
# Channels with less than this share of the largest variance are rounding noise and count as having it.
_LEAST_VARIANCE = 1e-8


class DescriptorCodec(nn.Module, ABC):
    """Turns descriptors into codes, a few bytes each, and back. Fitted to the descriptors of one object.

    Codes are constants: what is decoded has no gradient w.r.t. them, though it has w.r.t. the codec's buffers.
    """

    @abstractmethod
    def encode(self, descriptors: Tensor) -> Tensor:
        """Codes (M, n), uint8, of descriptors (M, d). Not differentiable."""

    @abstractmethod
    def decode(self, codes: Tensor) -> Tensor:
        """Approximate descriptors (..., d), in the type of the codec's buffers, of codes (..., n)."""


class ScalarCodec(DescriptorCodec):
    """A byte for each channel, ``descriptor ≈ offset + scale · code``; "int8" among the storages.

    Args:
        scale: (d,) step of each channel, positive.
        offset: (d,) value of code 0.
    """

    scale: Tensor
    offset: Tensor

    def __init__(self, scale: Tensor, offset: Tensor) -> None:
        super().__init__()
        if scale.ndim != 1 or scale.shape != offset.shape:
            raise ValueError(
                f"scale and offset must both have shape (d,), got {tuple(scale.shape)} and {tuple(offset.shape)}"
            )
        self.register_buffer("scale", scale)
        self.register_buffer("offset", offset)

    def encode(self, descriptors: Tensor) -> Tensor:
        """Nearest levels; what lies beyond them gets the last one. Not differentiable."""
        blocks = descriptors.detach().split(_ROWS_PER_BLOCK)
        return torch.cat([_nearest_level(x, self.scale, self.offset).to(torch.uint8) for x in blocks])

    def decode(self, codes: Tensor) -> Tensor:
        """Descriptors (..., d) of codes (..., d). Differentiable w.r.t. ``scale`` and ``offset``."""
        return torch.addcmul(self.offset, codes.to(self.scale.dtype), self.scale)


class ProductCodec(DescriptorCodec):
    """Product quantisation: a byte for each group of channels, which names the nearest of 256 centroids.

    Args:
        centroids: (n, 256, d / n) of each group.
        channels: (n, d / n) int64, the channels in each group.

    Source: Jégou et al., "Product quantization for nearest neighbor search", PAMI 2011.
    """

    centroids: Tensor
    channels: Tensor
    _place: Tensor

    def __init__(self, centroids: Tensor, channels: Tensor) -> None:
        super().__init__()
        if centroids.ndim != 3 or centroids.shape[1] != _LEVELS or channels.shape != centroids.shape[::2]:
            raise ValueError(
                f"centroids and channels must have shapes (n, {_LEVELS}, w) and (n, w), got "
                f"{tuple(centroids.shape)} and {tuple(channels.shape)}"
            )
        self.register_buffer("centroids", centroids)
        self.register_buffer("channels", channels)
        # Where each channel stands among the groups laid side by side.
        self.register_buffer("_place", channels.flatten().argsort(), persistent=False)

    def encode(self, descriptors: Tensor) -> Tensor:
        """Nearest centroids in each group. Not differentiable."""
        blocks = []
        rows = max(1, _SCORES_PER_BLOCK // (len(self.centroids) * _LEVELS))
        for x in descriptors.detach().split(rows):
            # (n, m, w): the groups are a batch of matrix products.
            grouped = x[:, self.channels].transpose(0, 1)
            norms = self.centroids.square().sum(dim=2).unsqueeze(1)
            scores = torch.baddbmm(norms, grouped, self.centroids.transpose(1, 2), alpha=-2.0)
            blocks.append(scores.argmin(dim=2).T.to(torch.uint8))
        return torch.cat(blocks)

    def decode(self, codes: Tensor) -> Tensor:
        """Descriptors (..., d) of codes (..., n). Differentiable w.r.t. ``centroids``."""
        n = len(self.centroids)
        row = codes.to(torch.int64) + torch.arange(n, device=codes.device) * _LEVELS
        grouped = F.embedding(row, self.centroids.flatten(0, 1)).flatten(-2)
        return grouped.index_select(-1, self._place)


def check_storage(storage: str, subspaces: int, channels: int) -> None:
    """Check settings of :func:`compress`.

    Raises:
        ValueError: no such storage, or ``subspaces`` does not divide ``channels`` for "pq".
    """
    if storage not in get_args(Storage):
        raise ValueError(f"storage must be one of {get_args(Storage)}, got {storage!r}")
    if storage == "pq" and (subspaces < 1 or channels % subspaces):
        raise ValueError(
            f"pq_subspaces must divide the descriptors' {channels} components, got {subspaces}; take for example "
            f"{math.gcd(channels, 64)}"
        )


def compress(
    descriptors: Tensor, storage: Storage, subspaces: int = 64, seed: int = 0
) -> tuple[Tensor, DescriptorCodec | None]:
    """Bring descriptors into the form in which they are kept.

    Args:
        descriptors: (M, d) of all patches of an object, floating point.
        storage: "float32" or "float16": rounded; "int8": :class:`ScalarCodec`; "pq": :class:`ProductCodec`.
        subspaces: bytes of a descriptor with "pq"; divides d.
        seed: of what is drawn to fit the codecs.

    Returns:
        Descriptors (M, d), or codes, uint8; and what decodes them.

    Raises:
        ValueError: settings as :func:`check_storage` says, or descriptors that are not finite or do not fit float16.

    Not differentiable for "int8" and "pq".
    """
    check_storage(storage, subspaces, descriptors.shape[1])
    if storage == "float32":
        return descriptors.to(torch.float32), None
    if storage == "float16":
        stored = descriptors.to(torch.float16)
        if not bool(torch.isfinite(stored).all()):
            raise ValueError(
                f"descriptors of magnitude {float(descriptors.abs().max()):.3g} do not fit float16; "
                "use storage=float32"
            )
        return stored, None
    if len(descriptors) == 0 or not bool(torch.isfinite(descriptors).all()):
        raise ValueError(f"storage={storage} needs descriptors, all of them finite; check the extractor")
    descriptors = descriptors.detach()
    codec = (
        fit_scalar_codec(descriptors, seed)
        if storage == "int8"
        else fit_product_codec(descriptors, subspaces, seed)
    )
    return codec.encode(descriptors), codec


def fit_scalar_codec(descriptors: Tensor, seed: int = 0) -> ScalarCodec:
    """Learn each channel's scale and offset from descriptors (M, d): of some ranges, that of least squared error."""
    low, high = descriptors.amin(dim=0), descriptors.amax(dim=0)
    x = _draw_rows(descriptors, _ROWS_FOR_SCALES, seed)
    varies = high > low
    # A channel that is constant is level 0 of any scale.
    full = torch.where(varies, (high - low) / (_LEVELS - 1), torch.ones_like(low))
    least = torch.full_like(low, torch.inf)
    scale, offset = full, low
    for share in _RANGES:
        tried = full * share
        start = torch.where(varies, (low + high - tried * (_LEVELS - 1)) / 2, low)
        error = sum(
            torch.addcmul(start, _nearest_level(block, tried, start), tried).sub_(block).square_().sum(dim=0)
            for block in x.split(_ROWS_PER_BLOCK)
        )
        assert isinstance(error, Tensor)
        better = error < least
        least, scale, offset = (
            torch.where(better, new, old) for new, old in ((error, least), (tried, scale), (start, offset))
        )
    return ScalarCodec(scale, offset)


def fit_product_codec(descriptors: Tensor, subspaces: int, seed: int = 0) -> ProductCodec:
    """Learn groups of channels and their centroids from descriptors (M, d) after PCA."""
    channels = balanced_groups(descriptors.var(dim=0, correction=0), subspaces)
    x = _draw_rows(descriptors, _LEVELS * _ROWS_PER_CENTROID, seed)
    centroids = [_centroids(x[:, group], seed) for group in channels]
    return ProductCodec(torch.stack(centroids), channels)


def balanced_groups(variance: Tensor, groups: int) -> Tensor:
    """Share out channels in groups of one size, so that the products of their variances are about equal.

    For uncorrelated Gaussian channels that makes the error of product quantisation least. Channels go, by falling
    variance, to the group whose product is smallest so far.

    Args:
        variance: (d,) of each channel.
        groups: number n of groups, divides d.

    Returns:
        (n, d / n) int64, on the device of ``variance``.

    Source: Ge et al., "Optimized product quantization", PAMI 2014, eigenvalue allocation.
    """
    size = len(variance) // groups
    known = variance.cpu().double()
    known = known.clamp(min=max(float(known.max()) * _LEAST_VARIANCE, torch.finfo(torch.float64).tiny))
    # None below 0: else the fullest group would have the smallest product.
    gain = (known / known.min()).log()
    members: list[list[int]] = [[] for _ in range(groups)]
    product = [0.0] * groups
    for channel in gain.argsort(descending=True, stable=True).tolist():
        group = min((g for g in range(groups) if len(members[g]) < size), key=product.__getitem__)
        members[group].append(channel)
        product[group] += float(gain[channel])
    return torch.tensor(members, device=variance.device)


def codec_from_state(state: Mapping[str, Tensor]) -> DescriptorCodec | None:
    """The codec with a state dict; None for an empty one.

    Raises:
        ValueError: no codec has such a state.
    """
    if not state:
        return None
    for codec, names in ((ScalarCodec, ("scale", "offset")), (ProductCodec, ("centroids", "channels"))):
        if set(state) == set(names):
            return codec(*(state[name] for name in names))
    raise ValueError(f"no descriptor codec consists of {sorted(state)}")


def _nearest_level(x: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
    return x.sub(offset).div_(scale).round_().clamp_(0, _LEVELS - 1)


def _draw_rows(x: Tensor, count: int, seed: int) -> Tensor:
    """Some rows, the same on every device."""
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(seed))[:count]
    return x[order.to(x.device)]


def _centroids(points: Tensor, seed: int) -> Tensor:
    """256 centroids (256, w); of fewer distinct points each is a centroid, and the last one repeats."""
    distinct = torch.unique(points.cpu(), dim=0)
    if len(distinct) > _LEVELS:
        return kmeans(points, _LEVELS, _KMEANS_ITERATIONS, seed).centroids
    centroids = torch.cat([distinct, distinct[-1:].expand(_LEVELS - len(distinct), -1)])
    return centroids.to(points.device)

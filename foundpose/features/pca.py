"""Exact principal component analysis of patch descriptors, fitted from a stream of batches."""

from typing import Any, Self

import torch
from torch import Tensor, nn

from foundpose.optimization.derivatives import eigenbasis

_ROWS_PER_BLOCK = 8192


class CovarianceAccumulator:
    """Mean and covariance of vectors that arrive in batches; the memory is that of one C × C matrix.

    Batches are merged by the pairwise update of Chan et al. (1979), which stays accurate where the mean is
    large beside the spread. Sums are float64 (float32 on devices without float64). Statistics are constants
    for autograd: samples are detached.

    Args:
        channels: length C of a vector.
        device: where the sums live; samples are moved there.

    Attributes:
        count: number of vectors seen.
        mean: (C,).
        scatter: (C, C) sum of outer products of the centred vectors.
    """

    def __init__(self, channels: int, device: torch.device | str = "cpu") -> None:
        if channels < 1:
            raise ValueError(f"channels must be at least 1, got {channels}")
        dtype = torch.float32 if torch.device(device).type == "mps" else torch.float64
        self.channels = channels
        self.count = 0
        self.mean = torch.zeros(channels, dtype=dtype, device=device)
        self.scatter = torch.zeros(channels, channels, dtype=dtype, device=device)

    def update(self, x: Tensor) -> Self:
        """Add vectors.

        Args:
            x: (n, C); n may be 0.

        Returns:
            The accumulator itself.

        Raises:
            ValueError: If ``x`` has another shape.
        """
        if x.ndim != 2 or x.shape[1] != self.channels:
            raise ValueError(f"x must have shape (n, {self.channels}), got {tuple(x.shape)}")
        for block in x.detach().split(_ROWS_PER_BLOCK):
            if block.shape[0] > 0:
                block = block.to(self.mean)
                mean = block.mean(dim=0)
                centred, delta = block - mean, mean - self.mean
                count, total = block.shape[0], self.count + block.shape[0]
                self.scatter += centred.T @ centred
                self.scatter += torch.outer(delta, delta * (self.count * count / total))
                self.mean += delta * (count / total)
                self.count = total
        return self

    def covariance(self) -> Tensor:
        """Unbiased covariance (C, C).

        Raises:
            ValueError: With fewer than two samples.
        """
        if self.count < 2:
            raise ValueError(f"a covariance needs at least two samples, got {self.count}")
        return self.scatter / (self.count - 1)


def principal_components(covariance: Tensor, num_components: int) -> tuple[Tensor, Tensor]:
    """Leading eigenvectors of a covariance, with deterministic signs.

    Args:
        covariance: (C, C), symmetric.
        num_components: number d of directions.

    Returns:
        Components (d, C), orthonormal rows whose entry of largest magnitude is positive, and the variances
        (d,) along them, descending.

    Raises:
        ValueError: If the covariance is not finite or zero.

    Differentiable (once) w.r.t. ``covariance``; directions whose variances agree do not turn into each other.
    """
    channels = covariance.shape[0]
    if covariance.shape != (channels, channels):
        raise ValueError(f"covariance must have shape (C, C), got {tuple(covariance.shape)}")
    if not 1 <= num_components <= channels:
        raise ValueError(
            f"num_components must be between 1 and the {channels} channels, got {num_components}"
        )
    if not bool(torch.isfinite(covariance).all()):
        raise ValueError("the covariance has NaN or infinite entries: check the descriptors it was made of")
    variances, vectors = eigenbasis(covariance)
    variances, components = variances.flip(0), vectors.flip(1).T
    if not bool(variances[0] > 0):
        raise ValueError(
            "the covariance is zero: all samples are the same, which leaves nothing to project on"
        )
    components = components[:num_components]
    largest = components.gather(1, components.abs().argmax(dim=1, keepdim=True))
    # Rounding leaves tiny negative variances where the samples span fewer dimensions.
    return components * largest.sign(), variances[:num_components].clamp(min=0.0)


class PcaProjection(nn.Module):
    """Projection of descriptors to the leading principal components, without whitening.

    Until it is fitted (or a state dict is loaded) the buffers are empty. They keep the module's floating-point
    type and device, so ``.double()`` or ``.to(device)`` before fitting holds afterwards. They are constants for
    autograd, whatever they were fitted to; :meth:`make_trainable` turns mean and components into parameters.

    Args:
        num_components: number d of components.

    Attributes:
        mean: (C,) mean of the samples.
        components: (d, C) orthonormal rows.
        explained_variance: (d,) variances along the components, descending.

    Source: paper, "Patch descriptors registered in 3D" (φ_d).
    """

    mean: Tensor
    components: Tensor
    explained_variance: Tensor

    def __init__(self, num_components: int = 256) -> None:
        super().__init__()
        if num_components < 1:
            raise ValueError(f"num_components must be at least 1, got {num_components}")
        self.num_components = num_components
        self.register_buffer("mean", torch.empty(0))
        self.register_buffer("components", torch.empty(0, 0))
        self.register_buffer("explained_variance", torch.empty(0))

    @property
    def is_fitted(self) -> bool:
        """Whether the projection has components."""
        return self.components.numel() > 0

    def fit(self, accumulator: CovarianceAccumulator) -> Self:
        """Set the components from the statistics of the samples.

        Raises:
            ValueError: If there are more components than channels or than samples, or all samples are the same.
        """
        if accumulator.count < self.num_components:
            raise ValueError(
                f"num_components is {self.num_components} but there are {accumulator.count} samples only: "
                "ask for fewer components or give more samples"
            )
        return self._set(accumulator.mean, accumulator.covariance())

    @classmethod
    def from_covariance(cls, mean: Tensor, covariance: Tensor, num_components: int) -> Self:
        """Projection from a mean (C,) and a covariance (C, C)."""
        return cls(num_components)._set(mean, covariance)

    def make_trainable(self) -> Self:
        """Turn ``mean`` and ``components`` into parameters, for an optimiser to find in ``parameters()``.

        The state dict keeps its names; loading it into another projection gives buffers there, and so does
        fitting. Nothing keeps trained components orthonormal. What was made with the components before (words and
        descriptors of an ``ObjectRepresentation``) does not follow them.

        Returns:
            The projection itself.

        Raises:
            RuntimeError: Before the projection is fitted.
        """
        self._check_fitted()
        for name in ("mean", "components"):
            value = getattr(self, name)
            if not isinstance(value, nn.Parameter):
                delattr(self, name)
                setattr(self, name, nn.Parameter(value.detach()))
        return self

    def forward(self, x: Tensor) -> Tensor:
        """Project descriptors.

        Args:
            x: (..., C) descriptors.

        Returns:
            (..., d) coordinates along the components.

        Raises:
            RuntimeError: Before the projection is fitted.
            ValueError: If the descriptors have another length.

        Differentiable w.r.t. ``x``, and after :meth:`make_trainable` w.r.t. ``mean`` and ``components``.
        """
        self._check_fitted()
        if x.shape[-1] != self.mean.shape[0]:
            raise ValueError(f"x must have shape (..., {self.mean.shape[0]}), got {tuple(x.shape)}")
        return (x - self.mean) @ self.components.T

    def extra_repr(self) -> str:
        """Shape of the projection, for printing."""
        channels = self.mean.shape[0] if self.is_fitted else "unfitted"
        return f"num_components={self.num_components}, channels={channels}"

    def _set(self, mean: Tensor, covariance: Tensor) -> Self:
        if mean.shape != covariance.shape[:1]:
            raise ValueError(
                f"mean and covariance must have shapes (C,) and (C, C), got {tuple(mean.shape)} and "
                f"{tuple(covariance.shape)}"
            )
        components, variances = principal_components(covariance.detach(), self.num_components)
        fitted = {"mean": mean.detach().clone(), "components": components, "explained_variance": variances}
        for name, value in fitted.items():
            value = value.to(getattr(self, name).detach())
            delattr(self, name)  # it may be a parameter
            self.register_buffer(name, value)
        return self

    def _check_fitted(self) -> None:
        if not self.is_fitted:
            raise RuntimeError("PcaProjection is not fitted: call fit() or load a state dict first")

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # Buffers of an unfitted (or otherwise fitted) module take the shapes that were saved.
        saved = state_dict.get(prefix + "components")
        if saved is not None and saved.numel() > 0 and saved.shape[0] != self.num_components:
            raise ValueError(
                f"state dict holds {saved.shape[0]} components, num_components is {self.num_components}"
            )
        for name, buffer in list(self.named_buffers(recurse=False)):
            value = state_dict.get(prefix + name)
            if value is not None and value.shape != buffer.shape:
                setattr(self, name, buffer.new_empty(value.shape))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

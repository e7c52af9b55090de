"""What the stages of onboarding hand on, and how they tell of their progress."""

from typing import NamedTuple, Protocol

from torch import Tensor

from foundpose.features.pca import PcaProjection


class Progress(Protocol):
    """Is told how far a long computation has come."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``stage`` are finished."""


class TemplatePictures(NamedTuple):
    """Rendered templates.

    Attributes:
        levels: (B, 3, S, S) colours as integers; see :func:`foundpose.onboarding.compression.quantize`.
        masks: (B, S, S) bool.
    """

    levels: Tensor
    masks: Tensor


class PatchTable(NamedTuple):
    """Valid patches of T templates, one after another.

    Attributes:
        points_model: (M, 3) mesh units.
        patch_index: (M,) int64, cell ``row * grid + column``.
        counts: (T,) int64, patches of each template.
    """

    points_model: Tensor
    patch_index: Tensor
    counts: Tensor


class RawDescriptors(NamedTuple):
    """What the extractor says of T templates.

    Attributes:
        descriptors: (M, C) of the valid patches, float32.
        template_cls: (T, C') global descriptors, float32; (T, 0) if the extractor has none.
    """

    descriptors: Tensor
    template_cls: Tensor


class FittedWords(NamedTuple):
    """What is fitted to the descriptors of all templates.

    Attributes:
        projection: fitted PCA.
        words: (k, d).
        descriptors: (M, d) projected, float32.
    """

    projection: PcaProjection
    words: Tensor
    descriptors: Tensor


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Tell nobody."""

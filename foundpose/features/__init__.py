"""Patch extractors, token hooks and PCA.

Nothing here imports transformers before a ``DinoV2`` is constructed.
"""

from foundpose.features.adapter import AdaptedExtractor, ResidualAdapter
from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.features.dense_sift import DenseSift
from foundpose.features.dinov2 import DinoV2
from foundpose.features.dinov2_checkpoints import WeightsNotFoundError
from foundpose.features.hook import FeatureHook
from foundpose.features.oracle import CoordinateCode, PatchNoise
from foundpose.features.pca import PcaProjection

__all__ = [
    "AdaptedExtractor",
    "CoordinateCode",
    "DenseSift",
    "DinoV2",
    "FeatureHook",
    "Fingerprint",
    "PatchExtractor",
    "PatchFeatures",
    "PatchNoise",
    "PcaProjection",
    "ResidualAdapter",
    "WeightsNotFoundError",
]

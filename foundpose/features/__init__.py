"""Patch extractors, token hooks and PCA.

Nothing here imports transformers before an extractor that needs it is constructed, and nothing imports torchvision.
"""

from foundpose.features.adapter import AdaptedExtractor, ResidualAdapter
from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.features.dense_sift import DenseSift
from foundpose.features.dino import Dino
from foundpose.features.dinov2 import DinoV2
from foundpose.features.hook import FeatureHook
from foundpose.features.loftr import LoftrBackbone
from foundpose.features.oracle import CoordinateCode, PatchNoise
from foundpose.features.pca import PcaProjection
from foundpose.features.s2dnet import S2DNet
from foundpose.features.vision_transformer import Clip, DinoV3, Sam, VisionTransformer
from foundpose.features.weights import WeightsNotFoundError

__all__ = [
    "AdaptedExtractor",
    "Clip",
    "CoordinateCode",
    "DenseSift",
    "Dino",
    "DinoV2",
    "DinoV3",
    "FeatureHook",
    "Fingerprint",
    "LoftrBackbone",
    "PatchExtractor",
    "PatchFeatures",
    "PatchNoise",
    "PcaProjection",
    "ResidualAdapter",
    "S2DNet",
    "Sam",
    "VisionTransformer",
    "WeightsNotFoundError",
]

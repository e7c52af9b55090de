"""The patches of crops: which of them count, and their descriptors."""

import torch
from torch import Tensor

from foundpose.features.base import PatchExtractor, PatchFeatures
from foundpose.geometry import Crops
from foundpose.representation import ObjectGroups, ObjectRepresentation, take_rows
from foundpose.retrieval import QueryPatches


def select_query_patches(features: PatchFeatures, crops: Crops, extractor: PatchExtractor) -> QueryPatches:
    """Patches whose centre lies in the crop's mask, first and padded to the most of any crop in the batch.

    Args:
        features: patches (B, C, h, w) of the crops.
        crops: the crops.
        extractor: knows where the patches are centred.

    Returns:
        Raw descriptors (B, P, C), pixels, validity and the global descriptors.

    Differentiable w.r.t. the features.
    """
    size = crops.images.shape[-1]
    grid = extractor.patch_grid(size)
    pixels = grid.centers(crops.masks.device, crops.masks.dtype)
    valid = (grid.sample(crops.masks[:, None]).flatten(1) > 0.5) & crops.valid[:, None]
    if features.patches.shape[-2:] != pixels.shape[:2]:
        raise ValueError(
            f"the extractor declares a grid of {tuple(pixels.shape[:2])} patches for crops of {size} px but "
            f"returned {tuple(features.patches.shape[-2:])}"
        )
    # One read of the batch's largest count; a stable sort keeps the patches in raster order.
    most = max(int(valid.sum(dim=1).max()), 1) if len(valid) else 1
    order = torch.argsort(~valid, dim=1, stable=True)[:, :most]
    descriptors = features.patches.flatten(2).transpose(1, 2)
    descriptors = descriptors.gather(1, order.unsqueeze(-1).expand(-1, -1, descriptors.shape[-1]))
    return QueryPatches(descriptors, pixels.reshape(-1, 2)[order], valid.gather(1, order), features.cls)


def describe_query(
    features: PatchFeatures, crops: Crops, extractor: PatchExtractor, groups: ObjectGroups
) -> QueryPatches:
    """The patches of :func:`select_query_patches` as each crop's object describes them: projected by its PCA.

    Differentiable w.r.t. the features.
    """
    raw = select_query_patches(features, crops, extractor)

    def project(obj: ObjectRepresentation, rows: Tensor) -> QueryPatches:
        part = take_rows(raw, rows)
        descriptors = part.descriptors.to(obj.projection.components.dtype)
        return part._replace(descriptors=obj.projection(descriptors))

    return groups.map(project)

"""How much regions look like objects."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.detection.proposals import Pictures, Proposals
from foundpose.features import PatchExtractor
from foundpose.geometry import PatchGrid, PerspectiveCrop
from foundpose.representation import ObjectRepresentation

# Masks that are cropped at a time.
_MASKS = 64


class ProposalScorer(nn.Module, ABC):
    """Compares proposals with objects.

    Attributes:
        needs_descriptors: whether :class:`Pictures` must hold descriptors.
    """

    needs_descriptors = False

    @abstractmethod
    def forward(
        self,
        pictures: Pictures,
        proposals: Proposals,
        objects: Sequence[ObjectRepresentation],
        extractor: PatchExtractor,
        wanted: Tensor,
    ) -> Tensor:
        """Compare.

        Args:
            pictures: N pictures.
            proposals: P of each.
            objects: O representations.
            extractor: that the objects were onboarded with.
            wanted: (N, P, O) bool, which pairs to compare.

        Returns:
            (N, P, O), about [0, 1], the larger the more alike; 0 for pairs that are not wanted.

        Differentiable w.r.t. the pictures' images or descriptors; the regions are constants.
        """


class TemplateViews(NamedTuple):
    """What regions are compared with.

    Attributes:
        means: (T, C) of each template's patches, in the extractor's own space as far as the PCA kept it.
        shapes: (T, G²) which of its patches are on the object.
    """

    means: Tensor
    shapes: Tensor


class ViewsOfTemplates(nn.Module):
    """The views of an object, found once for each object."""

    def __init__(self) -> None:
        super().__init__()
        self._known: WeakKeyDictionary[ObjectRepresentation, TemplateViews] = WeakKeyDictionary()

    def forward(self, obj: ObjectRepresentation) -> TemplateViews:
        """See :class:`TemplateViews`."""
        views = self._known.get(obj)
        if views is None or views.means.device != obj.words.device:
            counts = obj.template_offsets.diff()
            template = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
            total = obj.words.new_zeros(len(counts), obj.words.shape[1])
            # In parts: all descriptors at once would undo what a file that is mapped into memory saves.
            for rows in torch.arange(len(template), device=template.device).split(1 << 16):
                total = total.index_add(0, template[rows], obj.read_descriptors(rows).detach())
            means = (total / counts.clamp_min(1)[:, None]) @ obj.projection.components + obj.projection.mean
            shapes = obj.words.new_zeros(len(counts), obj.info.grid**2)
            shapes[template, obj.patch_index.long()] = 1.0
            views = self._known[obj] = TemplateViews(means, shapes)
        return views


class MeanDescriptorScorer(ProposalScorer):
    """Compares a region's shape and the mean descriptor of its patches with those of an object's templates.

    Quick: the patches of the picture are described once for all regions and objects; of several scales the first is
    looked at.

    Args:
        views: the similarity is the mean of that to so many of the most similar templates.
        rivals: so much of a region's lead over the other objects is added: what looks like all objects is rather
            none. Without other objects nothing is.
        shape: weight of the shape beside the descriptor's 1.
        crop: turns the regions as crops are, of which only the masks are looked at, so that few pixels will do; None:
            shapes are not compared.
    """

    needs_descriptors = True

    def __init__(
        self, views: int = 5, rivals: float = 0.5, shape: float = 0.5, crop: PerspectiveCrop | None = None
    ) -> None:
        super().__init__()
        _check(views, shape)
        self.views = views
        self.rivals = rivals
        self.shape = shape
        self.crop = crop
        self.of_templates = ViewsOfTemplates()

    def forward(
        self,
        pictures: Pictures,
        proposals: Proposals,
        objects: Sequence[ObjectRepresentation],
        extractor: PatchExtractor,
        wanted: Tensor,
    ) -> Tensor:
        """Similarity, see :class:`ProposalScorer`."""
        if pictures.descriptors is None:
            raise ValueError("MeanDescriptorScorer needs the descriptors of the pictures (DensePatches)")
        described = pictures.descriptors[0]
        of_picture = []
        for n, (patches, masks) in enumerate(zip(described.descriptors, proposals.masks, strict=True)):
            share = described.share_of(masks).flatten(1)
            mean = share @ patches.flatten(1).T.to(share) / share.sum(1, keepdim=True).clamp_min(1e-6)
            turned = None if self.crop is None else self._turned(pictures, n, masks, self.crop)
            scores = []
            for obj in objects:
                views = self.of_templates(obj)
                similarity = _cosine(mean, views.means)
                if turned is not None:
                    similarity = _with_shape(similarity, turned, views, obj, self.shape)
                scores.append(_of_best_views(similarity, self.views))
            of_picture.append(torch.stack(scores, dim=-1))
        similarity = _with_lead(torch.stack(of_picture), self.rivals)
        return torch.where(wanted, similarity, similarity.new_zeros(()))

    def _turned(self, pictures: Pictures, n: int, masks: Tensor, crop: PerspectiveCrop) -> Tensor:
        """Masks (P, S, S) in the cameras of their crops."""
        image, K = pictures.images[n, None].detach(), pictures.K[n, None]
        parts = [
            crop(image, K, part, None, torch.zeros(len(part), dtype=torch.int64)).masks
            for part in masks.split(_MASKS)
        ]
        return torch.cat(parts) if parts else masks.new_zeros(0, crop.size, crop.size, dtype=image.dtype)


class CropScorer(ProposalScorer):
    """Compares a region's crop with the templates, as CNOS does.

    The region is cropped as for pose estimation, with black background; the cosine similarity of its global
    descriptor to a template's, that of the mean of its patches in the mask to the mean of the template's, and the
    overlap of its shape with the template's are averaged over the most similar templates.

    Args:
        crop: cuts the crops.
        views: number of the most similar templates.
        patches: weight of the mean patch beside the global descriptor, in [0, 1]; 1 where the extractor has no
            global descriptor.
        rivals: so much of a region's lead over the other objects is added.
        shape: weight of the shape beside the descriptors' 1; 0 is CNOS's score.
        batch_size: crops that are described at a time.
        margin: describe them without what lies around, as :class:`foundpose.FoundPose` does.

    Source: Nguyen et al., "CNOS: A Strong Baseline for CAD-based Novel Object Segmentation", 2023. Geometry beside it
    is after Lin et al., "SAM-6D", 2024, who compare boxes.
    """

    def __init__(
        self,
        crop: PerspectiveCrop,
        views: int = 5,
        patches: float = 0.5,
        rivals: float = 0.5,
        shape: float = 0.25,
        batch_size: int = 16,
        margin: int | None = None,
    ) -> None:
        super().__init__()
        _check(views, shape)
        if not 0 <= patches <= 1:
            raise ValueError(f"patches must be in [0, 1], got {patches}")
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self.crop = crop
        self.views = views
        self.patches = patches
        self.rivals = rivals
        self.shape = shape
        self.batch_size = batch_size
        self.margin = margin
        self.of_templates = ViewsOfTemplates()

    def forward(
        self,
        pictures: Pictures,
        proposals: Proposals,
        objects: Sequence[ObjectRepresentation],
        extractor: PatchExtractor,
        wanted: Tensor,
    ) -> Tensor:
        """Similarity, see :class:`ProposalScorer`; each region that is wanted for any object is described once."""
        score = torch.zeros(wanted.shape, device=wanted.device)
        for part in wanted.any(dim=-1).nonzero().split(self.batch_size):
            image, region = part.unbind(1)
            of_crops = self._compare(pictures, proposals.masks[image, region], image, objects, extractor)
            score = score.index_put((image, region), of_crops)
        return torch.where(wanted, score, score.new_zeros(()))

    def _compare(
        self,
        pictures: Pictures,
        masks: Tensor,
        image: Tensor,
        objects: Sequence[ObjectRepresentation],
        extractor: PatchExtractor,
    ) -> Tensor:
        """Similarity (B, O) of masks (B, H, W) and objects."""
        crops = self.crop(pictures.images, pictures.K, masks, None, image)
        border = extractor.border(self.crop.size, self.crop.fill, self.margin)
        described = extractor.within(crops.images, border)
        share = extractor.patch_grid(self.crop.size).sample(crops.masks[:, None]).flatten(1)
        inside = (share > 0.5).to(described.patches)[:, None]
        patches = described.patches.flatten(2)
        mean = (patches * inside).sum(-1) / inside.sum(-1).clamp_min(1.0)
        scores = []
        for obj in objects:
            views = self.of_templates(obj)
            similarity = _cosine(mean, views.means)
            if described.cls is not None and obj.template_cls is not None:
                of_cls = _cosine(described.cls, obj.template_cls)
                similarity = self.patches * similarity + (1 - self.patches) * of_cls
            similarity = _with_shape(similarity, crops.masks, views, obj, self.shape)
            scores.append(_of_best_views(similarity, self.views))
        usable = crops.valid & (inside.sum(-1) > 0)[:, 0]
        compared = _with_lead(torch.stack(scores, dim=-1), self.rivals)
        return torch.where(usable[:, None], compared, compared.new_zeros(())).float()


def _cosine(descriptors: Tensor, templates: Tensor) -> Tensor:
    """Cosine similarity (B, T) of descriptors (B, C) and templates (T, C)."""
    return F.normalize(descriptors, dim=1) @ F.normalize(templates.to(descriptors), dim=1).T


def _with_shape(
    similarity: Tensor, masks: Tensor, views: TemplateViews, obj: ObjectRepresentation, weight: float
) -> Tensor:
    """Similarities (B, T) averaged with the overlap of shapes (intersection over union of patches).

    Args:
        similarity: of the descriptors.
        masks: (B, S, S) of crops of any size.
        views: of the object.
        obj: the object.
        weight: of the overlap, beside 1.
    """
    if weight == 0.0:
        return similarity
    grid, scale = obj.info.patch_grid, masks.shape[-1] / obj.info.image_size
    scaled = PatchGrid(grid.stride * scale, (grid.offset + 0.5) * scale - 0.5, grid.size)
    inside = (scaled.sample(masks[:, None]) > 0.5).flatten(1).to(views.shapes)
    both = inside @ views.shapes.T
    either = inside.sum(1)[:, None] + views.shapes.sum(1) - both
    return (similarity + weight * (both / either.clamp_min(1.0)).to(similarity)) / (1.0 + weight)


def _of_best_views(similarity: Tensor, views: int) -> Tensor:
    """Mean (B,) of the largest of similarities (B, T)."""
    return similarity.topk(min(views, similarity.shape[1]), dim=1).values.mean(dim=1)


def _with_lead(similarity: Tensor, weight: float) -> Tensor:
    """Similarities (..., O) with so much of their lead over the best other object added."""
    if similarity.shape[-1] < 2:
        return similarity
    best, second = similarity.topk(2, dim=-1).values.split(1, dim=-1)
    return similarity + weight * (similarity - torch.where(similarity == best, second, best))


def _check(views: int, shape: float) -> None:
    if views < 1:
        raise ValueError(f"views must be at least 1, got {views}")
    if shape < 0:
        raise ValueError(f"shape must be at least 0, got {shape}")

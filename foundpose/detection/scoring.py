"""How much regions look like objects."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from weakref import WeakKeyDictionary

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.detection.proposals import Pictures, Proposals
from foundpose.features import PatchExtractor
from foundpose.geometry import PerspectiveCrop
from foundpose.representation import ObjectRepresentation


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


class TemplateMeans(nn.Module):
    """Mean descriptors of an object's templates, found once for each object."""

    def __init__(self) -> None:
        super().__init__()
        self._known: WeakKeyDictionary[ObjectRepresentation, Tensor] = WeakKeyDictionary()

    def forward(self, obj: ObjectRepresentation) -> Tensor:
        """Means (T, C) of each template's patches, in the extractor's own space as far as the PCA kept it."""
        means = self._known.get(obj)
        if means is None or means.device != obj.words.device:
            counts = obj.template_offsets.diff()
            template = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
            total = obj.words.new_zeros(len(counts), obj.words.shape[1])
            # In parts: all descriptors at once would undo what a file that is mapped into memory saves.
            for rows in torch.arange(len(template), device=template.device).split(1 << 16):
                total = total.index_add(0, template[rows], obj.read_descriptors(rows).detach())
            means = (total / counts.clamp_min(1)[:, None]) @ obj.projection.components + obj.projection.mean
            self._known[obj] = means
        return means


class MeanDescriptorScorer(ProposalScorer):
    """Compares the mean descriptor of a region's patches with those of an object's templates.

    Quick: the patches of the picture are described once for all regions and objects; of several scales the first is
    looked at.

    Args:
        views: the similarity is the mean of that to so many of the most similar templates.
        rivals: so much of a region's lead over the other objects is added: what looks like all objects is rather
            none. Without other objects nothing is.
    """

    needs_descriptors = True

    def __init__(self, views: int = 5, rivals: float = 0.5) -> None:
        super().__init__()
        _check_views(views)
        self.views = views
        self.rivals = rivals
        self.means = TemplateMeans()

    def forward(
        self,
        pictures: Pictures,
        proposals: Proposals,
        objects: Sequence[ObjectRepresentation],
        extractor: PatchExtractor,
        wanted: Tensor,
    ) -> Tensor:
        """Cosine similarity, see :class:`ProposalScorer`."""
        if pictures.descriptors is None:
            raise ValueError("MeanDescriptorScorer needs the descriptors of the pictures (DensePatches)")
        described = pictures.descriptors[0]
        of_picture = []
        for patches, masks in zip(described.descriptors, proposals.masks, strict=True):
            share = described.share_of(masks).flatten(1)
            mean = share @ patches.flatten(1).T.to(share) / share.sum(1, keepdim=True).clamp_min(1e-6)
            alike = [_nearest_views(mean, self.means(obj), self.views) for obj in objects]
            of_picture.append(torch.stack(alike, dim=-1))
        similarity = torch.stack(of_picture)
        if len(objects) > 1:
            best, second = similarity.topk(2, dim=-1).values.split(1, dim=-1)
            similarity = similarity + self.rivals * (
                similarity - torch.where(similarity == best, second, best)
            )
        return torch.where(wanted, similarity, similarity.new_zeros(()))


class CropScorer(ProposalScorer):
    """Compares a region's crop with the templates, as CNOS does.

    The region is cropped as for pose estimation, with black background; the cosine similarity of its global
    descriptor to a template's, and that of the mean of its patches in the mask to the mean of the template's, are
    averaged over the most similar templates.

    Args:
        crop: cuts the crops.
        views: number of the most similar templates.
        patches: weight of the mean patch beside the global descriptor, in [0, 1]; 1 where the extractor has no
            global descriptor.
        rivals: so much of a region's lead over the other objects is added.
        batch_size: crops that are described at a time.

    Source: Nguyen et al., "CNOS: A Strong Baseline for CAD-based Novel Object Segmentation", 2023.
    """

    def __init__(
        self,
        crop: PerspectiveCrop,
        views: int = 5,
        patches: float = 0.5,
        rivals: float = 0.5,
        batch_size: int = 16,
    ) -> None:
        super().__init__()
        _check_views(views)
        if not 0 <= patches <= 1:
            raise ValueError(f"patches must be in [0, 1], got {patches}")
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self.crop = crop
        self.views = views
        self.patches = patches
        self.rivals = rivals
        self.batch_size = batch_size
        self.means = TemplateMeans()

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
        described = extractor(crops.images)
        share = extractor.patch_grid(self.crop.size).sample(crops.masks[:, None]).flatten(1)
        inside = (share > 0.5).to(described.patches)[:, None]
        patches = described.patches.flatten(2)
        mean = (patches * inside).sum(-1) / inside.sum(-1).clamp_min(1.0)
        scores = []
        for obj in objects:
            score = _nearest_views(mean, self.means(obj), self.views)
            if described.cls is not None and obj.template_cls is not None:
                of_cls = _nearest_views(described.cls, obj.template_cls, self.views)
                score = self.patches * score + (1 - self.patches) * of_cls
            scores.append(score)
        usable = crops.valid & (inside.sum(-1) > 0)[:, 0]
        compared = _with_lead(torch.stack(scores, dim=-1), self.rivals)
        return torch.where(usable[:, None], compared, compared.new_zeros(())).float()


def _nearest_views(descriptors: Tensor, templates: Tensor, views: int) -> Tensor:
    """Mean cosine similarity (B,) of descriptors (B, C) to the most similar templates (T, C)."""
    cosine = F.normalize(descriptors, dim=1) @ F.normalize(templates.to(descriptors), dim=1).T
    return cosine.topk(min(views, len(templates)), dim=1).values.mean(dim=1)


def _with_lead(similarity: Tensor, weight: float) -> Tensor:
    """Similarities (..., O) with so much of their lead over the best other object added."""
    if similarity.shape[-1] < 2:
        return similarity
    best, second = similarity.topk(2, dim=-1).values.split(1, dim=-1)
    return similarity + weight * (similarity - torch.where(similarity == best, second, best))


def _check_views(views: int) -> None:
    if views < 1:
        raise ValueError(f"views must be at least 1, got {views}")

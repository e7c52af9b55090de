"""Objects found in pictures: proposals, scored against the objects' templates."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.detection.dense import DensePatches
from foundpose.detection.proposals import Pictures, Proposals, Proposer, mask_overlaps, suppress
from foundpose.detection.scoring import ProposalScorer
from foundpose.features import PatchExtractor
from foundpose.representation import ExtractorChecks, ObjectRepresentation


class Detections(NamedTuple):
    """D detections of all pictures, as :class:`foundpose.FoundPose` takes them; the best of a picture first.

    Attributes:
        masks: (D, H, W) bool.
        score: (D,) in [0, 1].
        image_index: (D,) the picture, on the host.
        object_index: (D,) the object, on the host.
    """

    masks: Tensor
    score: Tensor
    image_index: Tensor
    object_index: Tensor


class Detector(nn.Module):
    """Finds objects in pictures by their templates; the templates are those that onboarding rendered.

    Args:
        extractor: that the objects were onboarded with.
        proposer: finds regions.
        scorer: compares regions with objects.
        preselection: a quicker scorer that chooses which regions ``scorer`` looks at; None: all of them.
        candidates: regions of each picture that are chosen for each object.
        dense: describes the pictures' patches, for stages that need them.
        overlap: of regions that overlap by more than this (intersection over union), the best is kept.
        across_objects: whether a region is one object's only: the best's (CNOS). False: each object has detections of
            its own, which may be of the same region.
        min_score: detections with less are dropped.
        max_detections: of an object in a picture.

    Raises:
        ValueError: an argument out of range, or a stage that needs descriptors without ``dense``.
    """

    def __init__(
        self,
        extractor: PatchExtractor,
        proposer: Proposer,
        scorer: ProposalScorer,
        preselection: ProposalScorer | None = None,
        candidates: int = 64,
        dense: DensePatches | None = None,
        overlap: float = 0.5,
        across_objects: bool = False,
        min_score: float = 0.0,
        max_detections: int = 5,
    ) -> None:
        super().__init__()
        stages = (proposer, scorer, preselection)
        self.needs_descriptors = any(stage is not None and stage.needs_descriptors for stage in stages)
        if self.needs_descriptors and dense is None:
            raise ValueError("a stage of the detector needs the descriptors of whole pictures: give dense")
        if candidates < 1 or max_detections < 1:
            raise ValueError(
                f"candidates and max_detections must be at least 1, got {candidates} and {max_detections}"
            )
        if not 0 <= overlap <= 1:
            raise ValueError(f"overlap must be in [0, 1], got {overlap}")
        self.extractor = extractor
        self.proposer = proposer
        self.scorer = scorer
        self.preselection = preselection
        self.candidates = candidates
        self.dense = dense
        self.overlap = overlap
        self.across_objects = across_objects
        self.min_score = min_score
        self.max_detections = max_detections
        self._checks = ExtractorChecks()

    def forward(
        self,
        images: Tensor,
        K: Tensor,
        objects: Sequence[ObjectRepresentation] | ObjectRepresentation,
        names: Sequence[object] | None = None,
    ) -> Detections:
        """Find objects.

        Args:
            images: (N, 3, H, W) RGB in [0, 1].
            K: (N, 3, 3) intrinsics, pixels.
            objects: representations; one may be given without a list.
            names: of the pictures, for proposals that are kept by name.

        Raises:
            ValueError: shapes that do not fit, no object, or one that was onboarded with another extractor.

        The scores are differentiable w.r.t. ``images`` and the extractor's parameters as far as the scorer is; the
        regions and their choice are constants.
        """
        objects = [objects] if isinstance(objects, ObjectRepresentation) else list(objects)
        self._check(images, K, objects)
        pictures = Pictures(images, K, names=names)
        if self.needs_descriptors and self.dense is not None:
            pictures = pictures._replace(descriptors=self.dense(images, self.extractor))
        proposals = self.proposer(pictures)
        wanted = proposals.valid[..., None].expand(-1, -1, len(objects))
        if self.preselection is not None and proposals.masks.shape[1] > self.candidates:
            quick = self.preselection(pictures, proposals, objects, self.extractor, wanted).detach()
            chosen = quick.masked_fill(~wanted, -torch.inf).topk(self.candidates, dim=1).indices
            wanted = torch.zeros_like(wanted).scatter(1, chosen, True) & wanted
        score = self.scorer(pictures, proposals, objects, self.extractor, wanted)
        return self._choose(proposals, score.clamp(0, 1), wanted)

    def _choose(self, proposals: Proposals, score: Tensor, wanted: Tensor) -> Detections:
        """Suppress what overlaps, and list what is left."""
        masks, scores, images, labels = [], [], [], []
        for n in range(len(score)):
            pairs = (wanted[n] & (score[n] >= self.min_score) & (score[n] > 0)).nonzero()
            region, label = pairs.unbind(1)
            value = score[n][region, label]
            used, place = region.unique(return_inverse=True)
            overlaps = mask_overlaps(proposals.masks[n][used])[place][:, place]
            if not self.across_objects:
                overlaps = overlaps * (label[:, None] == label)
            kept = suppress(overlaps, value.detach(), self.overlap)
            rank = _rank_among_equals(label[kept])
            kept = kept[rank < self.max_detections]
            masks.append(proposals.masks[n][region[kept]])
            scores.append(value[kept])
            images.append(torch.full((len(kept),), n, dtype=torch.int64))
            labels.append(label[kept].cpu())
        return Detections(torch.cat(masks), torch.cat(scores), torch.cat(images), torch.cat(labels))

    def _check(self, images: Tensor, K: Tensor, objects: list[ObjectRepresentation]) -> None:
        if images.dim() != 4 or images.shape[1] != 3 or not images.is_floating_point() or not len(images):
            raise ValueError(
                f"images must be floating point (N, 3, H, W) with N at least 1, got {images.dtype} "
                f"{tuple(images.shape)}"
            )
        if K.shape != (len(images), 3, 3):
            raise ValueError(f"K must have shape ({len(images)}, 3, 3), got {tuple(K.shape)}")
        if not objects:
            raise ValueError("objects is empty: give at least one object representation")
        for obj in objects:
            self._checks(obj, self.extractor)


def _rank_among_equals(labels: Tensor) -> Tensor:
    """How many equal labels come before each one (D,)."""
    same = labels[:, None] == labels
    return torch.tril(same, -1).sum(dim=1)

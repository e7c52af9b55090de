"""From pictures and objects to instances with poses, without masks."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.detection import Detections, Detector
from foundpose.geometry import transform_points
from foundpose.pipeline.foundpose import FoundPose
from foundpose.pipeline.results import PoseEstimates
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation, take_rows


class FoundInstances(NamedTuple):
    """Instances of objects in pictures, D together: those of the first picture first, the best of a picture first.

    Attributes:
        detections: where they are, and what the detector says of them.
        estimates: their poses.
        score: (D,) the detector's score times the pose's, in [0, 1].
    """

    detections: Detections
    estimates: PoseEstimates
    score: Tensor


class DetectAndEstimate(nn.Module):
    """Finds objects in pictures and estimates their poses.

    The poses decide what the detector leaves open: they are estimated for all its detections of an object (at most
    its ``max_detections``), and the best are kept. Of instances of one object in the same place one is kept.

    Args:
        detector: finds regions.
        pipeline: estimates poses; its extractor must be the detector's.
        spacing: instances of one object are at least so many diameters apart.
        min_probability: poses that are right with less are no instances; for a pipeline with a confidence.
        batch_size: poses that are estimated at a time.
    """

    def __init__(
        self,
        detector: Detector,
        pipeline: FoundPose,
        spacing: float = 0.3,
        min_probability: float = 0.0,
        batch_size: int = 16,
    ) -> None:
        super().__init__()
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self.detector = detector
        self.pipeline = pipeline
        self.spacing = spacing
        self.min_probability = min_probability
        self.batch_size = batch_size

    def forward(
        self,
        images: Tensor,
        K: Tensor,
        objects: Sequence[ObjectRepresentation] | ObjectRepresentation,
        instances: int | Sequence[int] | None = 1,
        meshes: Sequence[Mesh] | Mesh | None = None,
        names: Sequence[object] | None = None,
    ) -> FoundInstances | None:
        """Find and estimate.

        Args:
            images: (N, 3, H, W) RGB in [0, 1].
            K: (N, 3, 3) intrinsics, pixels.
            objects: representations; one may be given without a list.
            instances: how many of each object a picture has at most, one number or one for each object; None: as many
                as have a pose.
            meshes: the objects' meshes, in the order of ``objects``, for refiners that render.
            names: of the pictures, for proposals that are kept by name.

        Returns:
            Instances with a valid pose; None where there is none in any picture.

        Raises:
            ValueError: as :class:`Detector` and :class:`FoundPose`, or ``instances`` that fit no object.

        Differentiable as :class:`FoundPose` is, for the instances that are kept; which are kept is constant.
        """
        objects = [objects] if isinstance(objects, ObjectRepresentation) else list(objects)
        most = _counts(instances, len(objects), self.detector.max_detections)
        found = self.detector(images, K, objects, names)
        if not len(found.score):
            return None

        def estimate(rows: Tensor) -> PoseEstimates:
            part = take_rows(found, rows)
            return self.pipeline(
                images, K, objects, part.masks, None, part.image_index, part.object_index, meshes
            )

        # Poses of all detections say which to keep; only those of the kept are held, and followed by autograd.
        valid, score, T = [], [], []
        with torch.no_grad():
            for rows in torch.arange(len(found.score)).split(self.batch_size):
                estimates = estimate(rows)
                valid.append(estimates.withhold(self.min_probability).valid)
                score.append(estimates.score)
                T.append(estimates.T_camera_from_model)
        of_poses = torch.cat(score) * torch.cat(valid)
        kept = self._choose(found, torch.cat(T), found.score.detach() * of_poses, objects, most)
        if not len(kept):
            return None
        estimates = estimate(kept)
        found = take_rows(found, kept)
        return FoundInstances(found, estimates, found.score * estimates.score)

    def _choose(
        self,
        found: Detections,
        T: Tensor,
        score: Tensor,
        objects: list[ObjectRepresentation],
        most: list[int],
    ) -> Tensor:
        """Which detections are instances, on the host: picture by picture, from the best score down."""
        order = score.argsort(descending=True, stable=True).tolist()
        order.sort(key=lambda i: int(found.image_index[i]))  # stable
        centers = _centers(T, found.object_index, objects).cpu()
        usable = (score > 0).tolist()
        kept: list[int] = []
        for i in order:
            image, label = int(found.image_index[i]), int(found.object_index[i])
            same = [k for k in kept if found.image_index[k] == image and found.object_index[k] == label]
            apart = self.spacing * objects[label].info.diameter
            near = any(float((centers[i] - centers[k]).norm()) < apart for k in same)
            if usable[i] and len(same) < most[label] and not near:
                kept.append(i)
        return torch.tensor(kept, dtype=torch.int64)


def _counts(instances: int | Sequence[int] | None, objects: int, detections: int) -> list[int]:
    """How many instances each object has at most.

    Raises:
        ValueError: a number that is none, or another number of them than objects.
    """
    if instances is None:
        return [detections] * objects
    counts = [instances] * objects if isinstance(instances, int) else list(instances)
    if len(counts) != objects or not all(isinstance(count, int) and count >= 1 for count in counts):
        raise ValueError(
            f"instances must be a number of at least 1, or one for each of the {objects} objects; got {instances}"
        )
    if max(counts) > detections:
        raise ValueError(
            f"instances={max(counts)} needs as many detections of an object; the detector's max_detections is "
            f"{detections}: raise it"
        )
    return counts


def _centers(T: Tensor, labels: Tensor, objects: list[ObjectRepresentation]) -> Tensor:
    """Middles (D, 3) of the objects' seen points under poses (D, 4, 4), in the camera's frame."""
    middles = torch.stack([(obj.points_model.amin(0) + obj.points_model.amax(0)) / 2 for obj in objects])
    return transform_points(T, middles.to(T)[labels.to(T.device)][:, None])[:, 0]

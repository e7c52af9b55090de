"""The composed method: from images and masks to poses."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from foundpose.features.base import PatchExtractor
from foundpose.geometry import Crops, PerspectiveCrop
from foundpose.pipeline.confidence import PoseConfidence, pose_evidence
from foundpose.pipeline.hypotheses import HypothesisMaker
from foundpose.pipeline.query import describe_query
from foundpose.pipeline.refining import RefineWhat, refine_estimates
from foundpose.pipeline.results import PoseEstimates
from foundpose.pipeline.selection import choose_coarse
from foundpose.refinement import Observation, PoseRefiner
from foundpose.rendering import Mesh, Renderer
from foundpose.representation import ExtractorChecks, ObjectGroups, ObjectRepresentation, take_rows
from foundpose.retrieval import Retriever
from foundpose.utils.warn import warn_caller


class FoundPose(nn.Module):
    """6D pose of onboarded objects (paper, Section 3).

    Args:
        crop: cuts perspective crops.
        extractor: describes their patches; must be the one that the objects were onboarded with.
        retriever: finds similar templates.
        hypotheses: finds a pose for each retrieved template: :class:`MatchAndSolve`, the paper's, or
            :class:`TemplateHypotheses`, which matches nothing.
        refiner: improves poses; None returns coarse ones.
        refine: "best": refine the best hypothesis. "all", or a number: refine those of all retrieved templates, or so
            many with the best scores, and keep the one whose refined pose is best: by the hypotheses' scorer, or by
            the refiner's own score where that looks at inliers only.
        confidence: says how probable it is that a pose is right; None: nothing does.
        margin: describe crops without the patches that lie farther than so many from the square that the mask's box
            fills, for extractors that can leave out a border: less work, and slightly other descriptors. None: whole.
    """

    def __init__(
        self,
        crop: PerspectiveCrop,
        extractor: PatchExtractor,
        retriever: Retriever,
        hypotheses: HypothesisMaker,
        refiner: PoseRefiner | None = None,
        refine: RefineWhat = "best",
        confidence: PoseConfidence | None = None,
        margin: int | None = None,
    ) -> None:
        super().__init__()
        if refine not in ("best", "all") and not (isinstance(refine, int) and refine >= 1):
            raise ValueError(f"refine must be best, all or a number of at least 1, got {refine!r}")
        self.crop = crop
        self.extractor = extractor
        self.retriever = retriever
        self.hypotheses = hypotheses
        self.refiner = refiner
        self.refine: RefineWhat = refine
        self.confidence = confidence
        self.border = extractor.border(crop.size, crop.fill, margin)
        self._checks = ExtractorChecks()

    def forward(
        self,
        images: Tensor,
        K: Tensor,
        objects: Sequence[ObjectRepresentation] | ObjectRepresentation,
        masks: Tensor | None = None,
        boxes: Tensor | None = None,
        image_index: Tensor | None = None,
        object_index: Tensor | None = None,
        meshes: Sequence[Mesh] | Mesh | None = None,
    ) -> PoseEstimates:
        """Estimate one pose for each mask (or box).

        Args:
            images: (N, 3, H, W) RGB in [0, 1].
            K: (N, 3, 3) intrinsics in pixels (integer coordinates are pixel centres).
            objects: representations of the objects; one may be given without a list.
            masks: (B, H, W), non-zero on the object.
            boxes: (B, 4) as ``(left, top, right, bottom)`` pixel edges, in place of masks or beside them.
            image_index: (B,) which image each mask belongs to; may be left out where B == N.
            object_index: (B,) which object each mask shows; may be left out for a single object.
            meshes: the objects' meshes, in the order of ``objects``, for refiners that render.

        Raises:
            ValueError: shapes that do not fit, or an object that was onboarded with another extractor or size
                (looked at when an object is first given).

        Differentiable w.r.t. ``images``, ``K``, ``boxes``, the extractor's parameters and the objects' buffers as far
        as the stages are. The poses depend on the descriptors through the matches' weights and (soft matching) 3D
        points: use :class:`SoftPatchMatcher`, or :class:`PatchMatcher` with a ``confidence_temperature``; with equal
        weights a hard match changes by jumps only, and the poses depend on the image by no gradient but through the
        crop's camera. The choice of templates, matches, RANSAC samples, inliers and of the best hypothesis is
        constant; ``candidates`` (soft selection in :class:`RansacPnp`) has a gradient in that choice. The object's
        templates are constants: they do not follow an extractor that is being trained.
        """
        objects = [objects] if isinstance(objects, ObjectRepresentation) else list(objects)
        self._check_objects(objects)
        crops: Crops = self.crop(images, K, masks, boxes, image_index)
        if len(crops.images) == 0:
            raise ValueError("there is nothing to estimate: masks or boxes have length 0")
        groups = ObjectGroups(objects, object_index, len(crops.images), crops.images.device)
        features = self.extractor.within(crops.images, self.border)
        # Autocast is for the extractor: elsewhere half precision moves points and changes neighbours.
        with torch.autocast(crops.images.device.type, enabled=False):
            observation = Observation(
                crops,
                features,
                self.extractor.patch_grid(self.crop.size),
                describe_query(features, crops, self.extractor, groups),
                groups,
                images,
                K,
                torch.arange(len(crops.images)) if image_index is None else image_index,
                [meshes] if isinstance(meshes, Mesh) else meshes,
            )
            query = observation.query
            templates = groups.map(lambda obj, rows: self.retriever(take_rows(query, rows), obj))
            found = self.hypotheses(templates, observation)
            estimates = choose_coarse(observation, templates, found)
            if self.refiner is not None:
                estimates = refine_estimates(
                    estimates, observation, self.hypotheses, self.refiner, self.refine
                )
            if self.confidence is None:
                return estimates
            evidence = pose_evidence(estimates, observation)
            probability = self.confidence(evidence) * estimates.valid
            return estimates._replace(probability=probability, evidence=evidence)

    @property
    def needs_meshes(self) -> bool:
        """Whether poses are refined, or anything is rendered: meshes may be left out otherwise."""
        return self.refiner is not None or any(isinstance(module, Renderer) for module in self.modules())

    def _check_objects(self, objects: list[ObjectRepresentation]) -> None:
        if not objects:
            raise ValueError("objects is empty: give at least one object representation")
        dimensions = {len(representation.projection.components) for representation in objects}
        if len(dimensions) > 1:
            raise ValueError(f"objects must share one PCA dimension, got {sorted(dimensions)}")
        for representation in objects:
            if self._checks(representation, self.extractor):
                self._warn_of_other_settings(representation)
            if representation.info.image_size != self.crop.size:
                raise ValueError(
                    f"the templates of {representation.info.name!r} are {representation.info.image_size} px wide, "
                    f"the crops {self.crop.size} px; use one size for both"
                )

    def _warn_of_other_settings(self, representation: ObjectRepresentation) -> None:
        """Templates and crops can be compared, but badly, if they were made with other settings."""
        mine: dict[str, str | float] = {"fill": self.crop.fill, "border": self.border}
        if isinstance(self.retriever, Retriever):
            mine |= self.retriever.onboarding_settings()
        for name, value in mine.items():
            theirs = representation.info.settings.get(name, 0 if name == "border" else value)
            if theirs != value:
                warn_caller(
                    f"{representation.info.name!r} was onboarded with {name}={theirs}, the pipeline uses {value}; "
                    "retrieval suffers when they differ"
                )

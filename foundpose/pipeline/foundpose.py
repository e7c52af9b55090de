"""The composed method: from images and masks to poses."""

import warnings
from collections.abc import Callable, Sequence
from typing import cast, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor, PatchFeatures
from foundpose.geometry import Crops, PerspectiveCrop, invert_transform
from foundpose.matching import PatchMatcher, SoftPatchMatcher
from foundpose.pipeline.grouping import combine, crops_of_objects, object_of_each_crop, take_rows
from foundpose.pipeline.results import (
    Correspondences,
    PoseEstimates,
    PoseHypotheses,
    PoseStatus,
    no_correspondences,
    template_hypotheses,
)
from foundpose.pipeline.selection import (
    RefineWhat,
    better_of_two,
    choose_coarse,
    choose_refined,
    hypotheses_to_refine,
)
from foundpose.pipeline.verification import HypothesisScorer, InlierScore
from foundpose.pnp import (
    PnpResult,
    PoseCandidates,
    RansacPnp,
    TemplatePoses,
    TemplateStart,
    TopTemplatePose,
)
from foundpose.pnp.soft_selection import choose_softly
from foundpose.refinement import PoseProposals, PoseRefiner
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from foundpose.retrieval import QueryPatches, RetrievedTemplates, Retriever
from foundpose.utils.devices import indices_on


class _ExtractorChecks:
    """Checks once for each representation that it was made with the extractor at hand.

    A fingerprint may cost a pass over all weights, so it is taken when an object or an extractor is new. Training the
    extractor after that is the caller's business.
    """

    def __init__(self, capacity: int = 1024) -> None:
        self.capacity = capacity
        self._extractor: PatchExtractor | None = None
        self._fingerprint: Fingerprint = {}
        self._passed: list[RepresentationInfo] = []

    def __call__(self, representation: ObjectRepresentation, extractor: PatchExtractor) -> bool:
        """Raise ValueError for another extractor; say whether the representation had not been seen before."""
        if extractor is not self._extractor:
            self._extractor, self._fingerprint, self._passed = extractor, extractor.fingerprint(), []
        if any(info is representation.info for info in self._passed):
            return False
        if representation.info.extractor != self._fingerprint:
            self._fingerprint = extractor.fingerprint()
        representation.check_extractor(self._fingerprint)
        self._passed = [*self._passed, representation.info][-self.capacity :]
        return True


class FoundPose(nn.Module):
    """6D pose of onboarded objects (paper, Section 3).

    Args:
        crop: cuts perspective crops.
        extractor: describes their patches; must be the one that the objects were onboarded with.
        retriever: finds similar templates.
        matcher: matches patches of crop and template.
        pnp: estimates a pose from each template's correspondences. With :class:`TopTemplatePose` the poses are those
            of the templates themselves: nothing is matched, the correspondences are empty (P = 0), and the most
            similar template's pose is the best.
        refiner: improves poses; None returns coarse ones.
        refine: "best": refine the best hypothesis. "all": refine those of all retrieved templates and keep the one
            whose refined pose is best: by the scorer, or by the refiner's own score where the scorer looks at
            inliers only.
        scorer: says which hypothesis is best; None means :class:`InlierScore`, the paper's. With
            :class:`TopTemplatePose` there is nothing to score.
        start: beside RANSAC's pose, each retrieved template's own pose, moved as the matches say, is polished; the
            one with the better score is kept. None: RANSAC alone (the paper).
    """

    def __init__(
        self,
        crop: PerspectiveCrop,
        extractor: PatchExtractor,
        retriever: Retriever,
        matcher: PatchMatcher | SoftPatchMatcher,
        pnp: RansacPnp | TopTemplatePose,
        refiner: PoseRefiner | None = None,
        refine: RefineWhat = "best",
        scorer: HypothesisScorer | None = None,
        start: TemplateStart | None = None,
    ) -> None:
        super().__init__()
        if refine not in get_args(RefineWhat):
            raise ValueError(f"refine must be one of {get_args(RefineWhat)}, got {refine!r}")
        self.crop = crop
        self.extractor = extractor
        self.retriever = retriever
        self.matcher = matcher
        self.pnp = pnp
        self.refiner = refiner
        self.refine: RefineWhat = refine
        self.scorer = InlierScore() if scorer is None else scorer
        self.start = start
        self._checks = _ExtractorChecks()

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
        members = crops_of_objects(object_index, len(crops.images), len(objects))
        features = self.extractor(crops.images)
        # Autocast is for the extractor: elsewhere half precision moves points and changes neighbours.
        with torch.autocast(crops.images.device.type, enabled=False):
            raw = select_query_patches(features, crops, self.extractor)
            query, templates, found, starts = self._search(objects, members, raw, crops)
            if isinstance(found, TemplatePoses):
                correspondences, candidates = no_correspondences(query, templates), None
                hypotheses = template_hypotheses(found, templates)
            else:
                correspondences = found
                hypotheses, candidates = self._solve(correspondences, query, crops, starts, objects, members)
            estimates = choose_coarse(crops, query, templates, correspondences, hypotheses, candidates)
            if self.refiner is None:
                return estimates
            rank = hypotheses_to_refine(estimates, self.refine)
            proposals = PoseProposals(
                T_crop_from_model=torch.take_along_dim(
                    hypotheses.T_crop_from_model, rank[..., None, None], dim=1
                ),
                score=hypotheses.score.gather(1, rank).to(crops.K_crop.dtype),
                valid=(hypotheses.status.gather(1, rank) == PoseStatus.OK) & crops.valid[:, None],
                template_index=templates.index.gather(1, rank),
                crops=crops,
                features=features,
                stride=self.extractor.stride,
                offset=self.extractor.offset,
                objects=objects,
                object_index=object_of_each_crop(members),
                images=images,
                K=K,
                image_index=torch.arange(len(crops.images)) if image_index is None else image_index,
                meshes=[meshes] if isinstance(meshes, Mesh) else meshes,
            )
            refined = self.refiner(proposals)
            if self.scorer.judges_poses and not isinstance(found, TemplatePoses):
                share = _inlier_share(hypotheses.num_inliers, query).gather(1, rank)
                score = self._score(refined.T_crop_from_model, share, query, crops, objects, members)
                refined = refined._replace(score=score)
            return choose_refined(estimates, proposals, refined, rank)

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
        mine: dict[str, str | float] = {"fill": self.crop.fill}
        if isinstance(self.retriever, Retriever):
            mine |= self.retriever.onboarding_settings()
        for name, value in mine.items():
            theirs = representation.info.settings.get(name, value)
            if theirs != value:
                warnings.warn(
                    f"{representation.info.name!r} was onboarded with {name}={theirs}, the pipeline uses {value}; "
                    "retrieval suffers when they differ",
                    stacklevel=4,
                )

    def _search(
        self, objects: list[ObjectRepresentation], members: list[Tensor], raw: QueryPatches, crops: Crops
    ) -> tuple[QueryPatches, RetrievedTemplates, Correspondences | TemplatePoses, Tensor | None]:
        """Retrieve and match object by object: the crops of one object share its words and templates.

        Returns the patches, the templates, what was found of them, and the templates' poses (B, h, 4, 4) moved as the
        matches say, where the pipeline starts from these as well.
        """
        parts = []
        for representation, crop_index in zip(objects, members, strict=True):
            if len(crop_index) > 0:
                rows = indices_on(raw.valid.device, crop_index)
                parts.append(self._search_object(representation, take_rows(raw, rows), crops, rows))
        join = _back_to_batch(members)
        queries, retrieved, found, starts = zip(*parts, strict=True)
        T_start = None if any(T is None for T in starts) else join(list(starts))
        return combine(queries, join), combine(retrieved, join), combine(found, join), T_start

    def _search_object(
        self, representation: ObjectRepresentation, raw: QueryPatches, crops: Crops, rows: Tensor
    ) -> tuple[QueryPatches, RetrievedTemplates, Correspondences | TemplatePoses, Tensor | None]:
        """Project and retrieve, then match or align templates, for the patches ``raw`` of some of the crops."""
        descriptors = raw.descriptors.to(representation.projection.components.dtype)
        query = raw._replace(descriptors=representation.projection(descriptors))
        templates = self.retriever(query, representation)
        if isinstance(self.pnp, TopTemplatePose):
            poses = self.pnp(crops.masks[rows], crops.K_crop[rows], templates.index, representation)
            return query, templates, poses, None
        found = self._match(representation, query, templates)
        if self.start is None:
            return query, templates, found, None
        # Matches that lead back to where they come from count more.
        trust = found.valid / (1.0 - found.priority.clamp(min=-1e6) / self.extractor.stride)
        start = self.start(
            found.points_image,
            found.pixels_template,
            trust,
            crops.K_crop[rows],
            representation.T_template_from_model[templates.index],
            representation.K_template[templates.index],
            representation.points_model.mean(dim=0),
        )
        return query, templates, found, start

    def _match(
        self, representation: ObjectRepresentation, query: QueryPatches, templates: RetrievedTemplates
    ) -> Correspondences:
        """Match crops of one object with their templates."""
        patches = representation.gather_templates(templates.index)
        template_valid = patches.valid & templates.valid.unsqueeze(-1)
        matches = self.matcher(
            query.descriptors,
            query.valid,
            patches.descriptors,
            template_valid,
            query.pixels,
            patches.points_model,
            representation.info.scales.get("match"),
        )
        chosen = matches.template_patch.unsqueeze(-1)
        return Correspondences(
            points_image=query.pixels,
            points_model=matches.points_model.to(query.pixels),
            pixels_template=patches.pixels.gather(2, chosen.expand(-1, -1, -1, 2)).to(query.pixels),
            distance=matches.distance,
            weight=matches.weight.to(query.pixels),
            valid=matches.valid,
            priority=matches.priority.to(query.pixels),
        )

    def _solve(
        self,
        correspondences: Correspondences,
        query: QueryPatches,
        crops: Crops,
        starts: Tensor | None,
        objects: list[ObjectRepresentation],
        members: list[Tensor],
    ) -> tuple[PoseHypotheses, PoseCandidates | None]:
        """PnP for all crops and templates as one batch, from samples and from the templates' own poses."""
        B, h, P = correspondences.valid.shape
        pnp = cast(RansacPnp, self.pnp)  # the other kind has no correspondences
        problem = (
            correspondences.points_image.unsqueeze(1).expand(-1, h, -1, -1).reshape(B * h, P, 2),
            correspondences.points_model.reshape(B * h, P, 3),
            crops.K_crop.unsqueeze(1).expand(-1, h, -1, -1).reshape(B * h, 3, 3),
            correspondences.valid.reshape(B * h, P),
            correspondences.weight.reshape(B * h, P),
        )

        def scored(result: PnpResult) -> PoseHypotheses:
            T = result.T_camera_from_model.reshape(B, h, 4, 4)
            num_inliers = result.num_inliers.reshape(B, h)
            share = _inlier_share(num_inliers, query)
            return PoseHypotheses(
                T_crop_from_model=T,
                inliers=result.inliers.reshape(B, h, P),
                num_inliers=num_inliers,
                status=result.status.reshape(B, h),
                score=self._score(T, share, query, crops, objects, members),
            )

        result = pnp(*problem, correspondences.priority.reshape(B * h, P))
        hypotheses = scored(result)
        if starts is not None:
            from_starts = scored(pnp.polish_starts(starts.reshape(B * h, 4, 4), *problem))
            hypotheses = better_of_two(hypotheses, from_starts)
        if result.candidates is None or pnp.soft_selection is None:
            return hypotheses, None
        # One choice among the candidates of all templates of a crop, in place of one for each template.
        T, score, _, valid = (x.unflatten(0, (B, h)).flatten(1, 2) for x in result.candidates)
        T = invert_transform(crops.T_crop_from_camera).unsqueeze(1) @ T
        return hypotheses, choose_softly(T, score, valid, pnp.soft_selection.temperature)

    def _score(
        self,
        T_crop_from_model: Tensor,
        inlier_share: Tensor,
        query: QueryPatches,
        crops: Crops,
        objects: list[ObjectRepresentation],
        members: list[Tensor],
    ) -> Tensor:
        """Scores (B, n) of poses (B, n, 4, 4), object by object."""
        parts = []
        for representation, crop_index in zip(objects, members, strict=True):
            if len(crop_index) > 0:
                rows = indices_on(inlier_share.device, crop_index)
                parts.append(
                    self.scorer(
                        T_crop_from_model[rows],
                        inlier_share[rows],
                        take_rows(query, rows),
                        crops.K_crop[rows],
                        representation,
                    )
                )
        return _back_to_batch(members)(parts)


def _back_to_batch(members: list[Tensor]) -> Callable[[list[Tensor]], Tensor]:
    """What joins tensors of the crops of each object, in the batch's order."""
    order = torch.cat(members).argsort()

    def join(fields: list[Tensor]) -> Tensor:
        return torch.cat(fields)[indices_on(fields[0].device, order)]

    return join


def _inlier_share(num_inliers: Tensor, query: QueryPatches) -> Tensor:
    """Inliers (B, h) as shares of the crops' patches."""
    return num_inliers / query.valid.sum(dim=1, keepdim=True).clamp(min=1)


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
    pixels = extractor.patch_centers(size, crops.images.device, crops.images.dtype)
    grid = (2 * pixels + 1) / size - 1
    share = F.grid_sample(
        crops.masks[:, None], grid.expand(len(crops.masks), -1, -1, -1), align_corners=False
    )
    valid = (share.flatten(1) > 0.5) & crops.valid[:, None]
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

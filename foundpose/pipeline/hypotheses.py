"""From retrieved templates to pose hypotheses: by matching and PnP, or from the templates' own poses."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from foundpose.geometry import invert_transform
from foundpose.matching import Matcher
from foundpose.pipeline.results import Correspondences, Hypothesised, PoseHypotheses, PoseStatus
from foundpose.pipeline.selection import better_of_two
from foundpose.pipeline.verification import HypothesisScorer, InlierScore
from foundpose.pnp import PnpProblem, PnpResult, RansacPnp, TemplateStart, TopTemplatePose
from foundpose.pnp.soft_selection import choose_softly
from foundpose.refinement import Observation, PoseProposals, PoseRefiner
from foundpose.representation import ObjectRepresentation, take_rows
from foundpose.retrieval import QueryPatches, RetrievedTemplates


class HypothesisMaker(nn.Module, ABC):
    """Finds a pose for each retrieved template of each crop."""

    @abstractmethod
    def forward(self, templates: RetrievedTemplates, observation: Observation) -> Hypothesised:
        """Find poses.

        Args:
            templates: h templates of the object of each of B crops.
            observation: the crops, their patches and their objects.
        """

    def score_refined(
        self, T_crop_from_model: Tensor, num_inliers: Tensor, observation: Observation
    ) -> Tensor | None:
        """Scores (B, n) of refined poses (B, n, 4, 4) on the scale of the hypotheses' own.

        None where those do not depend on the pose: the refiner's own scores count then.
        """
        return None


class MatchAndSolve(HypothesisMaker):
    """Matches the patches of crop and template, and solves PnP for each template (the paper).

    Args:
        matcher: matches patches of crop and template.
        pnp: estimates a pose from each template's correspondences.
        scorer: says how good a pose is; None means :class:`InlierScore`, the paper's.
        start: beside RANSAC's pose, each retrieved template's own pose, moved as the matches say, is polished; the
            one with the better score is kept. None: RANSAC alone (the paper).
    """

    def __init__(
        self,
        matcher: Matcher,
        pnp: RansacPnp,
        scorer: HypothesisScorer | None = None,
        start: TemplateStart | None = None,
    ) -> None:
        super().__init__()
        self.matcher = matcher
        self.pnp = pnp
        self.scorer = InlierScore() if scorer is None else scorer
        self.start = start

    def forward(self, templates: RetrievedTemplates, observation: Observation) -> Hypothesised:
        """Match object by object; PnP for all crops and templates as one batch."""
        query, crops, groups = observation.query, observation.crops, observation.groups
        found = groups.map(
            lambda obj, rows: self._match(obj, take_rows(query, rows), take_rows(templates, rows))
        )
        B, h, P = found.valid.shape
        problem = PnpProblem(
            found.points_image.unsqueeze(1).expand(-1, h, -1, -1).reshape(B * h, P, 2),
            found.points_model.reshape(B * h, P, 3),
            crops.K_crop.unsqueeze(1).expand(-1, h, -1, -1).reshape(B * h, 3, 3),
            found.valid.reshape(B * h, P),
            found.weight.reshape(B * h, P),
        )

        def scored(result: PnpResult) -> PoseHypotheses:
            T = result.T_camera_from_model.reshape(B, h, 4, 4)
            num_inliers = result.num_inliers.reshape(B, h)
            return PoseHypotheses(
                T_crop_from_model=T,
                inliers=result.inliers.reshape(B, h, P),
                num_inliers=num_inliers,
                status=result.status.reshape(B, h),
                score=self._score(T, num_inliers, observation),
            )

        result = self.pnp(problem, found.priority.reshape(B * h, P))
        hypotheses = scored(result)
        if self.start is not None:
            T_start = self._starts(self.start, found, templates, observation)
            polished = self.pnp.polish_starts(T_start.reshape(B * h, 4, 4), problem)
            hypotheses = better_of_two(hypotheses, scored(polished))
        candidates = None
        if result.candidates is not None and self.pnp.soft_selection is not None:
            # One choice among the candidates of all templates of a crop, in place of one for each template.
            T, score, _, valid = (x.unflatten(0, (B, h)).flatten(1, 2) for x in result.candidates)
            T = invert_transform(crops.T_crop_from_camera).unsqueeze(1) @ T
            candidates = choose_softly(T, score, valid, self.pnp.soft_selection.temperature)
        return Hypothesised(hypotheses, found, candidates)

    def score_refined(
        self, T_crop_from_model: Tensor, num_inliers: Tensor, observation: Observation
    ) -> Tensor | None:
        """By the scorer, unless it looks at inliers alone."""
        if not self.scorer.judges_poses:
            return None
        return self._score(T_crop_from_model, num_inliers, observation)

    def _match(
        self, representation: ObjectRepresentation, query: QueryPatches, templates: RetrievedTemplates
    ) -> Correspondences:
        """Match crops of one object with their templates."""
        patches = representation.gather_templates(templates.index)
        patches = patches._replace(valid=patches.valid & templates.valid.unsqueeze(-1))
        matches = self.matcher(query, patches, representation.info.scales.get("match"))
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

    def _starts(
        self,
        start: TemplateStart,
        found: Correspondences,
        templates: RetrievedTemplates,
        observation: Observation,
    ) -> Tensor:
        """The templates' own poses (B, h, 4, 4), moved as the matches say."""

        def move(obj: ObjectRepresentation, rows: Tensor) -> Tensor:
            # Matches that lead back to where they come from count more.
            trust = found.valid[rows] / (1.0 - found.priority[rows].clamp(min=-1e6) / obj.info.stride)
            index = templates.index[rows]
            return start(
                found.points_image[rows],
                found.pixels_template[rows],
                trust,
                observation.crops.K_crop[rows],
                obj.T_template_from_model[index],
                obj.K_template[index],
                obj.points_model.mean(dim=0),
            )

        return observation.groups.map(move)

    def _score(self, T_crop_from_model: Tensor, num_inliers: Tensor, observation: Observation) -> Tensor:
        """Scores (B, n) of poses (B, n, 4, 4)."""
        query, K_crop = observation.query, observation.crops.K_crop
        share = num_inliers / query.valid.sum(dim=1, keepdim=True).clamp(min=1)

        def score(obj: ObjectRepresentation, rows: Tensor) -> Tensor:
            return self.scorer(
                T_crop_from_model[rows], share[rows], take_rows(query, rows), K_crop[rows], obj
            )

        return observation.groups.map(score)


class TemplateHypotheses(HypothesisMaker):
    """The templates' own poses, moved so that the object's bounding circle is that of the mask; nothing is matched.

    As good as the templates are similar, or as the scorer judges: with all templates and MegaPose's coarse network it
    is MegaPose's coarse stage.

    Args:
        pose: aligns templates; None means ``TopTemplatePose()``.
        scorer: a refiner whose scores are taken, and its poses; None: the similarity of the templates is the score.

    Source: paper, Table 2, row 10; Labbé et al., "MegaPose", CoRL 2022.
    """

    def __init__(self, pose: TopTemplatePose | None = None, scorer: PoseRefiner | None = None) -> None:
        super().__init__()
        self.pose = TopTemplatePose() if pose is None else pose
        self.scorer = scorer

    def forward(self, templates: RetrievedTemplates, observation: Observation) -> Hypothesised:
        """Align the templates of each crop with its mask."""
        crops = observation.crops
        poses = observation.groups.map(
            lambda obj, rows: self.pose(crops.masks[rows], crops.K_crop[rows], templates.index[rows], obj)
        )
        status = poses.status.masked_fill(~templates.valid, int(PoseStatus.NO_TEMPLATE))
        T, score = poses.T_crop_from_model, templates.similarity
        if self.scorer is not None:
            valid = status == PoseStatus.OK
            scored = self.scorer(PoseProposals(T, score, valid, templates.index), observation)
            T, score = scored.T_crop_from_model, scored.score
            status = status.masked_fill(valid & ~scored.valid, int(PoseStatus.DEGENERATE))
        hypotheses = PoseHypotheses(
            T_crop_from_model=T,
            inliers=torch.zeros_like(templates.valid).unsqueeze(-1)[..., :0],
            num_inliers=torch.zeros_like(status),
            status=status,
            score=score,
        )
        return Hypothesised(hypotheses)

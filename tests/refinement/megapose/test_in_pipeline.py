"""MegaPose's stages among the others."""

import pytest
import torch
from torch import nn

from foundpose import FoundPose, MatchAndSolve, TemplateHypotheses
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, rotation_angle
from foundpose.matching import PatchMatcher
from foundpose.pnp import RansacPnp
from foundpose.refinement import MegaPoseRefiner, MegaPoseScorer, PoseRefiner, RefinerChain
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import EveryTemplate, SoftAssignBow, TemplateRetriever
from tests.pipeline.test_foundpose import SIZE, K, pose_at
from tests.refinement.megapose.test_refiner import stirred


class Difference(nn.Module):
    """Likes renderings that look like the crop."""

    head, views = "score", 1

    def forward(self, pictures):
        return -100.0 * (pictures[:, :3] - pictures[:, 3:6]).abs().mean((1, 2, 3)).unsqueeze(1)


class Recorder(PoseRefiner):
    """Leaves poses as they are and remembers them."""

    def forward(self, proposals, observation):
        self.proposals = proposals
        return proposals


@pytest.fixture(scope="module")
def views(blob):
    T = torch.stack([pose_at(blob, (300.0 + 8 * k, 230.0 - 5 * k), 700.0, k) for k in range(2)])
    images = torch.stack([render_coordinate_image(CoordinateRenderer(), [blob], [t], K, SIZE) for t in T])
    return images, CoordinateRenderer()(blob, T, K[None], SIZE).mask, T


def test_coarse_stage_finds_the_view_that_looks_like_the_picture(views, oracle_blob, blob):
    images, masks, T_true = views
    count = len(oracle_blob.T_template_from_model)
    scorer = MegaPoseScorer(Difference(), CoordinateRenderer(), resolution=(48, 64))
    parts = PerspectiveCrop(), CoordinateCode(), EveryTemplate(count + 3), TemplateHypotheses(scorer=scorer)
    recorder = Recorder()
    with torch.no_grad():
        e = FoundPose(*parts)(images, K.expand(2, 3, 3), oracle_blob, masks=masks, meshes=blob)
        some = FoundPose(*parts, recorder, refine=4)(
            images, K.expand(2, 3, 3), oracle_blob, masks=masks, meshes=blob
        )
    assert e.valid.all()
    T_true_crop = e.crops.T_crop_from_camera @ T_true
    angle = rotation_angle(e.hypotheses.T_crop_from_model[..., :3, :3], T_true_crop[:, None, :3, :3])[
        :, :count
    ]
    chosen = angle.gather(1, e.best[:, None])[:, 0]
    # The chosen view is the nearest one, or hardly further away.
    assert (chosen < angle.amin(1) + 0.1).all()
    # The four best are handed on, the best one first.
    best = e.hypotheses.score[:, :count].sort(dim=1, descending=True)
    assert torch.equal(recorder.proposals.template_index, best.indices[:, :4])
    torch.testing.assert_close(recorder.proposals.score, best.values[:, :4])
    assert torch.equal(some.best, e.best)
    assert torch.equal(some.T_camera_from_model, e.T_camera_from_model)


def test_scored_refinement_in_a_pipeline(views, oracle_blob, blob):
    images, masks, _ = views
    renderer = RaycastRenderer(1, 1.0)
    refiner = MegaPoseRefiner(stirred(), renderer, 2, resolution=(48, 64))
    scorer = MegaPoseScorer(Difference(), CoordinateRenderer(), resolution=(48, 64))
    parts = PerspectiveCrop(), CoordinateCode(), TemplateRetriever(SoftAssignBow())
    solve = MatchAndSolve(PatchMatcher(), RansacPnp())
    pipeline = FoundPose(*parts, solve, RefinerChain([refiner, scorer]), refine="all").eval()
    assert pipeline.needs_meshes
    assert not FoundPose(*parts, solve).needs_meshes
    with torch.no_grad():
        e = pipeline(images, K.expand(2, 3, 3), oracle_blob, masks=masks, meshes=blob)
    assert e.refined.valid.all()
    # The refined pose that looks most like the picture is kept, and all have moved.
    torch.testing.assert_close(e.score, e.refined.score.amax(1))
    assert ((e.score > 0) & (e.score < 1)).all()
    assert (e.refined.T_crop_from_model - e.hypotheses.T_crop_from_model).abs().amax((2, 3)).min() > 0

import pytest
import torch

from foundpose import FoundPose, MatchAndSolve, PoseStatus
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, rotation_angle
from foundpose.matching import PatchMatcher
from foundpose.optimization import BarronLoss
from foundpose.pnp import RansacPnp
from foundpose.refinement import (
    FeaturemetricAlignment,
    FeaturemetricRefiner,
    Observation,
    PoseProposals,
    PoseRefiner,
    RefinerChain,
)
from foundpose.rendering import CoordinateRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import SoftAssignBow, TemplateRetriever
from tests.pipeline.test_foundpose import SIZE, K, pose_at


def make_pipeline(**changes) -> FoundPose:
    parts = {
        "crop": PerspectiveCrop(),
        "extractor": CoordinateCode(),
        "retriever": TemplateRetriever(SoftAssignBow()),
        "hypotheses": MatchAndSolve(PatchMatcher(), RansacPnp()),
    }
    return FoundPose(**parts | changes)


def oracle_refiner(**settings) -> FeaturemetricRefiner:
    """For codes of coordinates, whose few leading channels carry nearly all."""
    return FeaturemetricRefiner(FeaturemetricAlignment(BarronLoss(-5.0, 0.5), residual="norm", **settings))


@pytest.fixture(scope="module")
def views(blob):
    """Pictures of the blob from six sides, masks and true poses."""
    T = torch.stack([pose_at(blob, (300.0 + 8 * k, 230.0 - 5 * k), 700.0, k) for k in range(6)])
    images = torch.stack([render_coordinate_image(CoordinateRenderer(), [blob], [t], K, SIZE) for t in T])
    masks = CoordinateRenderer()(blob, T, K[None], SIZE).mask
    return images, masks, T


def angles(T, T_true):
    return torch.rad2deg(rotation_angle(T[:, :3, :3], T_true[:, :3, :3]))


@pytest.mark.parametrize("refine", ["best", "all"])
def test_refinement_improves_coarse_poses(views, oracle_blob, blob, refine):
    images, masks, T_true = views
    pipeline = make_pipeline(refiner=oracle_refiner(), refine=refine)
    with torch.no_grad():
        e = pipeline(images, K.expand(6, 3, 3), oracle_blob, masks=masks)
        coarse = make_pipeline()(images, K.expand(6, 3, 3), oracle_blob, masks=masks)
    assert e.valid.all()
    before, after = angles(coarse.T_camera_from_model, T_true), angles(e.T_camera_from_model, T_true)
    assert after.median() < 0.5 * before.median()
    assert after.median() < 0.3
    assert (after < before).float().mean() > 0.8
    n = 1 if refine == "best" else 5
    assert e.refined.score.shape == (6, n)
    assert ((e.score > 0) & (e.score <= 1)).all()
    torch.testing.assert_close(e.score, e.refined.score.amax(1))
    if refine == "best":
        assert torch.equal(e.best, coarse.best)
        assert torch.equal(e.T_coarse, coarse.T_camera_from_model)
    # The coarse pose told is that of the hypothesis that was chosen.
    row = torch.arange(6)
    T = e.crops.T_crop_from_camera @ e.T_coarse
    torch.testing.assert_close(T, e.hypotheses.T_crop_from_model[row, e.best], rtol=1e-4, atol=1e-2)
    assert torch.equal(e.num_inliers, e.hypotheses.num_inliers[row, e.best])


def test_alone_as_in_a_batch_with_other_objects(views, oracle_blob, other_mesh, oracle_other):
    images, masks, _ = views
    T = pose_at(other_mesh, (310.0, 220.0), 650.0, 5)[None]
    image = render_coordinate_image(CoordinateRenderer(), [other_mesh], list(T), K, SIZE)
    mask = CoordinateRenderer()(other_mesh, T, K[None], SIZE).mask
    empty = torch.zeros_like(mask)
    pipeline = make_pipeline(refiner=oracle_refiner(), refine="all")
    with torch.no_grad():
        together = pipeline(
            torch.stack([images[0], image, images[1]]),
            K.expand(3, 3, 3),
            [oracle_blob, oracle_other],
            masks=torch.cat([mask, masks[:1], empty, masks[1:2]]),
            image_index=torch.tensor([1, 0, 0, 2]),
            object_index=torch.tensor([1, 0, 0, 0]),
        )
        alone = pipeline(images[1:2], K[None], oracle_blob, masks=masks[1:2])
        first = pipeline(image[None], K[None], oracle_other, masks=mask)
    assert together.valid.tolist() == [True, True, False, True]
    assert together.status[2] == PoseStatus.UNUSABLE_MASK
    assert together.score[2] == 0
    for single, b in ((alone, 3), (first, 0)):
        torch.testing.assert_close(
            single.T_camera_from_model[0], together.T_camera_from_model[b], rtol=1e-4, atol=2e-2
        )
        assert int(single.best[0]) == int(together.best[b])


class Stubborn(PoseRefiner):
    """Refuses everything."""

    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        nothing = torch.zeros_like(proposals.valid)
        return PoseProposals(
            proposals.T_crop_from_model + 1.0, proposals.score + 7, nothing, proposals.template_index
        )


def test_a_pose_that_cannot_be_refined_stays_as_it_was(views, oracle_blob):
    images, masks, _ = views
    with torch.no_grad():
        e = make_pipeline(refiner=Stubborn())(images[:2], K.expand(2, 3, 3), oracle_blob, masks=masks[:2])
        coarse = make_pipeline()(images[:2], K.expand(2, 3, 3), oracle_blob, masks=masks[:2])
    assert torch.equal(e.T_camera_from_model, coarse.T_camera_from_model)
    assert e.valid.all()
    assert (e.score == 0).all()


class Nudge(PoseRefiner):
    """Moves poses by a unit along the optical axis and counts itself in the score."""

    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        T = proposals.T_crop_from_model.clone()
        T[..., 2, 3] += 1.0
        return proposals._replace(T_crop_from_model=T, score=proposals.score + 1)


def test_a_chain_hands_poses_on(views, oracle_blob):
    images, masks, _ = views
    with torch.no_grad():
        once = make_pipeline(refiner=oracle_refiner())(images[:1], K[None], oracle_blob, masks=masks[:1])
        chain = RefinerChain([oracle_refiner(), Nudge(), Nudge()])
        e = make_pipeline(refiner=chain)(images[:1], K[None], oracle_blob, masks=masks[:1])
    moved = e.refined.T_crop_from_model - once.refined.T_crop_from_model
    expected = torch.zeros(4, 4)
    expected[2, 3] = 2.0
    torch.testing.assert_close(moved[0, 0], expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(e.score, once.score + 2)
    with pytest.raises(ValueError, match="refiners is empty"):
        RefinerChain([])


def test_gradients_pass_through_refinement(views, oracle_blob):
    images, masks, T_true = views
    picture = images[:1].clone().requires_grad_()
    e = make_pipeline(refiner=oracle_refiner())(picture, K[None], oracle_blob, masks=masks[:1])
    ((e.T_camera_from_model - T_true[:1])[:, :3].square().sum() + e.score.sum()).backward()
    assert torch.isfinite(picture.grad).all()
    assert picture.grad.abs().max() > 0


def test_bad_arguments():
    with pytest.raises(ValueError, match="refine must be best, all or a number"):
        make_pipeline(refine="some")


def recorded_problem(pipeline, *args, **kwargs):
    """The alignment problem that a pipeline's refiner is given, and the poses that it starts from."""
    seen = []
    pipeline.refiner.alignment.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    with torch.no_grad():
        estimates = pipeline(*args, **kwargs)
    return estimates, *seen[0]


def test_views_near_the_pose_take_the_templates_place(views, oracle_blob):
    images, masks, T_true = views
    refiner = FeaturemetricRefiner(oracle_refiner().alignment, num_views=3)
    pipeline = make_pipeline(refiner=refiner)
    e, T, problem = recorded_problem(pipeline, images, K.expand(6, 3, 3), oracle_blob, masks=masks)
    nearest = oracle_blob.nearest_views(T, 3)
    for row in range(6):
        angle = rotation_angle(T[row, :3, :3].expand(100, 3, 3), oracle_blob.T_template_from_model[:, :3, :3])
        assert set(nearest[row].tolist()) == set(angle.argsort()[:3].tolist())
    counts = oracle_blob.template_offsets.diff()[nearest].sum(1)
    assert torch.equal(problem.valid.sum(1), counts)
    before, after = angles(e.T_coarse, T_true), angles(e.T_camera_from_model, T_true)
    assert after.median() < before.median()


def test_patches_off_the_mask_are_left_out(views, oracle_blob):
    images, masks, _ = views
    half = masks.clone()
    half[:, :, : masks.shape[2] // 2] = False
    half[half.flatten(1).sum(1) < 500] = masks[half.flatten(1).sum(1) < 500]
    for margin in (0.0, 7.0):
        refiner = FeaturemetricRefiner(oracle_refiner().alignment, mask_margin=margin)
        e, T, problem = recorded_problem(
            make_pipeline(refiner=refiner), images, K.expand(6, 3, 3), oracle_blob, masks=half
        )
        _, _, whole = recorded_problem(
            make_pipeline(refiner=oracle_refiner()), images, K.expand(6, 3, 3), oracle_blob, masks=half
        )
        kept, checked = 0, 0
        for row in range(6):
            inside = (e.crops.masks[row] > 0.5).nonzero().flip(1).float()
            for p in range(0, whole.valid.shape[1], 7):
                if not whole.valid[row, p]:
                    assert not problem.valid[row, p]
                    continue
                x = T[row, :3, :3] @ whole.points_model[row, p] + T[row, :3, 3]
                u = (problem.K[row] @ x)[:2] / x[2]
                away = float((inside - u).abs().amax(1).min()) - margin
                if abs(away - 0.5) > 0.02:  # not at the very edge of a pixel
                    assert bool(problem.valid[row, p]) == (away < 0.5)
                    kept, checked = kept + int(away < 0.5), checked + 1
        assert 0 < kept < checked


def test_bad_settings_of_the_refiner():
    with pytest.raises(ValueError, match="num_views must be at least 1 or None, got 0"):
        FeaturemetricRefiner(num_views=0)
    with pytest.raises(ValueError, match="mask_margin must not be negative"):
        FeaturemetricRefiner(mask_margin=-1.0)


def test_the_loss_can_be_measured_by_the_object(views, oracle_blob):
    images, masks, _ = views
    size = oracle_blob.info.scales["match"]
    refiners = [
        FeaturemetricRefiner(
            FeaturemetricAlignment(BarronLoss(-5.0, scale), residual="norm", auto_scale=auto, tolerance=1e-6)
        )
        for scale, auto in ((1.0, "object"), (size, False))
    ]
    with torch.no_grad():
        measured, fixed = (
            make_pipeline(refiner=r)(images, K.expand(6, 3, 3), oracle_blob, masks=masks) for r in refiners
        )
    torch.testing.assert_close(measured.T_camera_from_model, fixed.T_camera_from_model, atol=0.05, rtol=1e-3)
    with pytest.raises(ValueError, match="knows no size of single channels"):
        FeaturemetricAlignment(auto_scale="object", normalize=True)

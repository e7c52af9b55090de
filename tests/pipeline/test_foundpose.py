import copy
import warnings

import pytest
import torch
from scipy.spatial.transform import Rotation

from foundpose import (
    FoundPose,
    MatchAndSolve,
    PatchVerification,
    PoseStatus,
    TemplateHypotheses,
    TemplateStart,
)
from foundpose.evaluation.records import pose_records
from foundpose.features import CoordinateCode, DenseSift, DinoV2, PatchNoise, PcaProjection
from foundpose.geometry import (
    PerspectiveCrop,
    SuperFibonacci,
    intrinsics_matrix,
    make_transform,
    pixel_rays,
    rotation_angle,
)
from foundpose.losses import PointMatchingLoss
from foundpose.matching import PatchMatcher, SoftPatchMatcher
from foundpose.onboarding import Onboarder
from foundpose.pnp import LevenbergMarquardtPnp, RansacPnp, SoftInlierSelection
from foundpose.refinement import FeaturemetricRefiner
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import (
    ClsRetriever,
    PatchVoteRetriever,
    RetrievedTemplates,
    Retriever,
    SoftAssignBow,
    TemplateRetriever,
    VisualWords,
)
from foundpose.retrieval.base import select_templates
from foundpose.synthetic import cluttered_scene

SIZE = (480, 640)
K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)


def make_pipeline(extractor=None, **changes):
    settings = {
        "crop": PerspectiveCrop(),
        "extractor": extractor or CoordinateCode(),
        "retriever": TemplateRetriever(SoftAssignBow()),
    }
    solving = {"matcher": PatchMatcher(), "pnp": RansacPnp()}
    solving |= {name: changes.pop(name) for name in ("matcher", "pnp", "scorer", "start") if name in changes}
    settings |= {"hypotheses": MatchAndSolve(**solving)}
    return FoundPose(**(settings | changes)).eval()


def pose_at(mesh, pixel, distance, seed):
    R = torch.from_numpy(Rotation.random(random_state=seed).as_matrix()).float()
    t = pixel_rays(torch.tensor([pixel]), K)[0] * distance - R @ mesh.bounds.mean(0)
    return make_transform(R, t)


@pytest.fixture(scope="module")
def scene(blob):
    """Two blobs in one picture of coordinates and their masks."""
    T = torch.stack([pose_at(blob, (180.0, 150.0), 700.0, 1), pose_at(blob, (430.0, 300.0), 900.0, 2)])
    renderer = CoordinateRenderer()
    image = render_coordinate_image(renderer, [blob, blob], list(T), K, SIZE)
    masks = renderer(blob, T, K.expand(2, 3, 3), SIZE).mask
    return image, masks, T


def errors(estimates, T_true):
    T = estimates.T_camera_from_model
    angle = torch.rad2deg(rotation_angle(T[:, :3, :3], T_true[:, :3, :3]))
    return angle, (T[:, :3, 3] - T_true[:, :3, 3]).norm(dim=1)


def test_true_coordinates_give_the_true_pose(scene, oracle_blob, blob):
    image, masks, T_true = scene
    with torch.no_grad():
        e = make_pipeline()(image[None], K[None], oracle_blob, masks=masks, image_index=torch.tensor([0, 0]))
    assert e.valid.all()
    assert (e.status == PoseStatus.OK).all()
    angle, distance = errors(e, T_true)
    assert angle.max() < 2.0
    assert distance.max() < 0.05 * blob.diameter
    assert (e.score > 0.7).all()
    assert torch.allclose(e.score, e.num_inliers / e.query.valid.sum(1))
    # The chosen hypothesis has the most inliers, and its pose is the one returned.
    assert torch.equal(e.num_inliers, e.hypotheses.num_inliers.amax(1))
    assert (e.templates.similarity.diff(dim=1) <= 0).all()
    row = torch.arange(2)
    T_crop = e.hypotheses.T_crop_from_model[row, e.best]
    assert torch.allclose(e.crops.T_crop_from_camera @ e.T_camera_from_model, T_crop, atol=1e-3)


def test_noise_on_a_third_of_the_patches(scene, oracle_blob):
    image, masks, T_true = scene
    pipeline = make_pipeline(PatchNoise(CoordinateCode(), 0.3))
    with torch.no_grad():
        e = pipeline(image[None], K[None], oracle_blob, masks=masks, image_index=torch.tensor([0, 0]))
    assert errors(e, T_true)[0].max() < 3.0
    assert (e.score > 0.45).all()


def test_alone_as_in_a_batch_with_other_objects(scene, oracle_blob, other_mesh, oracle_other):
    image, masks, T_true = scene
    T_other = pose_at(other_mesh, (300.0, 220.0), 600.0, 5)[None]
    renderer = CoordinateRenderer()
    images = torch.stack([image, render_coordinate_image(renderer, [other_mesh], list(T_other), K, SIZE)])
    empty = torch.zeros(1, *SIZE, dtype=torch.bool)
    all_masks = torch.cat([renderer(other_mesh, T_other, K[None], SIZE).mask, masks[:1], empty, masks[1:]])
    pipeline = make_pipeline()
    with torch.no_grad():
        batch = pipeline(
            images,
            K.expand(2, 3, 3),
            [oracle_blob, oracle_other],
            masks=all_masks,
            image_index=torch.tensor([1, 0, 0, 0]),
            object_index=torch.tensor([1, 0, 0, 0]),
        )
        alone = [
            pipeline(images[i][None], K[None], r, masks=all_masks[b : b + 1])
            for b, (i, r) in enumerate(
                ((1, oracle_other), (0, oracle_blob), (0, oracle_blob), (0, oracle_blob))
            )
        ]
    assert batch.valid.tolist() == [True, True, False, True]
    assert batch.status[2] == PoseStatus.UNUSABLE_MASK
    assert torch.isfinite(batch.T_camera_from_model).all()
    for b in (0, 1, 3):
        assert torch.equal(batch.templates.index[b], alone[b].templates.index[0])
        assert batch.num_inliers[b] == alone[b].num_inliers[0]
        assert torch.allclose(batch.T_camera_from_model[b], alone[b].T_camera_from_model[0], atol=0.02)
    assert not alone[2].valid[0]
    angle, _ = errors(batch, torch.cat([T_other, T_true[:1], T_true[:1], T_true[1:]]))
    assert angle[[0, 1, 3]].max() < 2.0


def test_other_settings_than_the_objects_are_warned_of_once(scene, oracle_blob):
    image, masks, _ = scene
    pipeline = make_pipeline(
        retriever=TemplateRetriever(SoftAssignBow(sigma=3.0)), crop=PerspectiveCrop(fill=0.5)
    )
    with torch.no_grad():
        with pytest.warns(UserWarning, match="retrieval suffers") as caught:
            pipeline(image[None], K[None], oracle_blob, masks=masks[:1])
        assert ["fill=0.6" in str(w.message) or "sigma=10.0" in str(w.message) for w in caught] == [
            True,
            True,
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            pipeline(image[None], K[None], oracle_blob, masks=masks[:1])


def test_boxes_in_place_of_masks(scene, oracle_blob):
    image, masks, T_true = scene
    rows, columns = torch.nonzero(masks[0], as_tuple=True)
    box = torch.tensor([[columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]])
    with torch.no_grad():
        e = make_pipeline()(image[None], K[None], oracle_blob, boxes=box)
    assert errors(e, T_true[:1])[0] < 3.0


def test_mask_without_patches_and_mask_of_background(scene, oracle_blob):
    image, _, _ = scene
    masks = torch.zeros(2, *SIZE, dtype=torch.bool)
    # A line so thin that no patch centre is inside it.
    masks[0, 100, 100:400] = True
    masks[1, 400:470, 10:90] = True
    with torch.no_grad():
        e = make_pipeline()(image[None], K[None], oracle_blob, masks=masks, image_index=torch.tensor([0, 0]))
    assert torch.isfinite(e.T_camera_from_model).all()
    assert e.status[0] == PoseStatus.NO_PATCHES
    # Noise may fit a few patches, but never many.
    assert e.score[1] < 0.2


def test_gradients_reach_image_and_descriptors(scene, oracle_blob):
    image, masks, _ = scene
    picture = image[None].clone().requires_grad_()
    e = make_pipeline()(picture, K[None], oracle_blob, masks=masks[:1])
    finite = e.correspondences.distance[e.correspondences.valid]
    (finite.mean() + e.templates.similarity.sum()).backward()
    assert torch.isfinite(picture.grad).all()
    assert picture.grad.abs().sum() > 0


def test_autocast_leaves_the_geometry_alone(scene, oracle_blob):
    image, masks, _ = scene
    with torch.no_grad():
        plain = make_pipeline()(image[None], K[None], oracle_blob, masks=masks[:1])
        with torch.autocast("cpu", dtype=torch.bfloat16):
            cast = make_pipeline()(image[None], K[None], oracle_blob, masks=masks[:1])
    assert torch.equal(plain.crops.K_crop, cast.crops.K_crop)
    assert torch.equal(plain.crops.images, cast.crops.images)
    assert cast.T_camera_from_model.dtype == torch.float32
    # The extractor alone is coarser.
    R, R_cast = plain.T_camera_from_model[0, :3, :3], cast.T_camera_from_model[0, :3, :3]
    assert torch.rad2deg(rotation_angle(R, R_cast)) < 3


def test_one_broken_camera_does_not_spoil_the_batch(scene, oracle_blob):
    image, masks, _ = scene
    cameras = torch.stack([K, torch.full((3, 3), torch.nan), torch.zeros(3, 3)])
    with torch.no_grad():
        e = make_pipeline()(image.expand(3, 3, *SIZE), cameras, oracle_blob, masks=masks[:1].expand(3, *SIZE))
        alone = make_pipeline()(image[None], K[None], oracle_blob, masks=masks[:1])
    assert e.status.tolist() == [PoseStatus.OK, PoseStatus.UNUSABLE_MASK, PoseStatus.UNUSABLE_MASK]
    assert torch.isfinite(e.T_camera_from_model).all()
    assert torch.allclose(e.T_camera_from_model[0], alone.T_camera_from_model[0], atol=0.02)


def test_another_extractor_is_noticed_when_it_is_swapped(scene, oracle_blob):
    image, masks, _ = scene
    pipeline = make_pipeline()
    with torch.no_grad():
        pipeline(image[None], K[None], oracle_blob, masks=masks[:1])
        pipeline.extractor = CoordinateCode(seed=5)
        with pytest.raises(ValueError, match="another extractor"):
            pipeline(image[None], K[None], oracle_blob, masks=masks[:1])


@pytest.mark.gpu
def test_cuda_equals_the_cpu(scene, oracle_blob, oracle_onboarder, blob):
    image, masks, T_true = scene
    index = torch.tensor([0, 0])
    on_gpu = copy.deepcopy(oracle_onboarder).cuda()(blob, "blob")
    with torch.no_grad():
        e = make_pipeline().cuda()(
            image[None].cuda(), K[None].cuda(), on_gpu, masks=masks.cuda(), image_index=index.cuda()
        )
        reference = make_pipeline()(image[None], K[None], oracle_blob, masks=masks, image_index=index)
    assert e.T_camera_from_model.is_cuda
    assert torch.allclose(on_gpu.points_model.cpu(), oracle_blob.points_model, atol=1e-2)
    assert errors(reference, T_true)[0].max() < 2.0
    R, R_gpu = reference.T_camera_from_model[:, :3, :3], e.T_camera_from_model.cpu()[:, :3, :3]
    assert torch.rad2deg(rotation_angle(R, R_gpu)).max() < 0.5


def test_bad_input(scene, oracle_blob):
    image, masks, _ = scene
    pipeline = make_pipeline()
    index = torch.tensor([0, 0])
    with pytest.raises(ValueError, match="another extractor"):
        make_pipeline(CoordinateCode(seed=1))(image[None], K[None], oracle_blob, masks=masks[:1])
    with pytest.raises(ValueError, match="templates of 'blob' are 420 px wide, the crops 280 px"):
        make_pipeline(crop=PerspectiveCrop(280))(image[None], K[None], oracle_blob, masks=masks[:1])
    with pytest.raises(ValueError, match=r"object_index \(B,\) is needed to tell 2 objects apart"):
        pipeline(image[None], K[None], [oracle_blob] * 2, masks=masks, image_index=index)
    with pytest.raises(ValueError, match=r"object_index must lie in \[0, 1\), got \[0, 1\]"):
        pipeline(
            image[None],
            K[None],
            [oracle_blob],
            masks=masks,
            image_index=index,
            object_index=torch.tensor([0, 1]),
        )
    with pytest.raises(ValueError, match="objects is empty"):
        pipeline(image[None], K[None], [], masks=masks[:1])
    with pytest.raises(ValueError, match="nothing to estimate"):
        pipeline(image[None], K[None], oracle_blob, masks=masks[:0], image_index=index[:0])


@pytest.fixture(scope="module")
def small_transformer(blob):
    """A small DINOv2 with random weights, bags of words, and an object onboarded with them."""
    size = {"hidden_size": 48, "num_attention_heads": 3, "num_hidden_layers": 2}
    extractor = DinoV2("vits14_reg", layer=1, seed=0, config=size, weights="random")
    bow = SoftAssignBow(sigma=1.0)
    onboarder = Onboarder(
        RaycastRenderer(), extractor, SuperFibonacci(20), VisualWords(50), bow, projection=PcaProjection(32)
    )
    return extractor, bow, onboarder(blob, "blob")


@pytest.fixture
def transformer(small_transformer):
    """The same, without the gradients of the tests before."""
    small_transformer[0].zero_grad()
    return small_transformer


def test_a_vision_transformer_takes_the_place_of_the_oracle(blob, transformer):
    """The whole path with DINOv2's architecture (small, random weights): it runs, and gradients reach the weights."""
    extractor, bow, representation = transformer
    assert representation.template_cls.shape == (20, 48)
    picture = cluttered_scene(blob, seed=3)
    pipeline = make_pipeline(extractor, retriever=TemplateRetriever(bow, num_templates=3))
    e = pipeline(picture.image[None], picture.K[None], representation, masks=picture.mask[None])
    assert e.hypotheses.T_crop_from_model.shape == (1, 3, 4, 4)
    assert torch.isfinite(e.T_camera_from_model).all()
    assert e.query.cls.shape == (1, 48)
    (e.correspondences.distance[e.correspondences.valid].mean() - e.templates.similarity.sum()).backward()
    assert_useful_gradients(extractor)


@torch.no_grad()
def test_a_margin_leaves_out_what_lies_around(blob, transformer):
    """The crop's outer patches are not described; none of them is the object's."""
    extractor, bow, representation = transformer
    picture = cluttered_scene(blob, seed=3)
    retriever = TemplateRetriever(bow, num_templates=3)
    hypotheses = MatchAndSolve(PatchMatcher(), RansacPnp(iterations=50))
    pipeline = FoundPose(PerspectiveCrop(), extractor, retriever, hypotheses, margin=1).eval()
    assert pipeline.border == 5  # of 30 patches; 84 px, six patches, lie beside the object
    with pytest.warns(UserWarning, match="onboarded with border=0, the pipeline uses 5"):
        e = pipeline(picture.image[None], picture.K[None], representation, masks=picture.mask[None])
    expected = extractor(e.observation.crops.images, 5)
    assert torch.equal(e.observation.features.patches, expected.patches)
    on_mask = e.observation.grid.sample(e.observation.crops.masks[:, None])[0, 0] > 0.5
    assert on_mask.any()
    assert expected.patches[0].abs().sum(0)[on_mask].min() > 0
    assert e.query.valid.sum() == on_mask.sum()


def assert_useful_gradients(module):
    gradients = {name: p.grad for name, p in module.named_parameters() if p.grad is not None}
    assert len(gradients) > 10
    assert all(torch.isfinite(g).all() for g in gradients.values())
    # Weights, not only biases of the last layer, at both ends of the network.
    for part in ("patch_embeddings", "layer.0.", "layer.1."):
        assert any(part in name and g.abs().max() > 0 for name, g in gradients.items()), part


@pytest.mark.parametrize("differentiation", ["implicit", "unrolled"])
@pytest.mark.parametrize(
    "matcher",
    [PatchMatcher(confidence_temperature=0.3), SoftPatchMatcher(0.3)],
    ids=["hard", "soft"],
)
@pytest.mark.parametrize("soft_selection", [None, SoftInlierSelection(4)], ids=["hard_choice", "soft_choice"])
def test_a_loss_on_the_pose_reaches_the_extractor(
    blob, transformer, matcher, soft_selection, differentiation
):
    extractor, bow, representation = transformer
    # A template as picture: random features recognise it, so there are inliers enough.
    T, intrinsics = representation.T_template_from_model[3], representation.K_template[3]
    render = RaycastRenderer()(blob, T[None], intrinsics[None], (420, 420))
    image = render.rgb * 0.9 + 0.02
    pipeline = make_pipeline(
        extractor,
        retriever=TemplateRetriever(bow, num_templates=3),
        matcher=matcher,
        pnp=RansacPnp(
            polish=LevenbergMarquardtPnp(differentiation=differentiation), soft_selection=soft_selection
        ),
    )
    e = pipeline(image, intrinsics[None], representation, masks=render.mask)
    assert e.valid.all()
    loss = PointMatchingLoss("l2")
    points = blob.hull_vertices
    if soft_selection is None:
        assert e.candidates is None
        value = loss(e.T_camera_from_model, T[None], points).sum()
    else:
        assert e.candidates.T_camera_from_model.shape == (1, 12, 4, 4)
        poses = e.candidates.T_camera_from_model.flatten(0, 1)
        losses = loss(poses, T.expand(12, 4, 4), points).unflatten(0, (1, 12))
        torch.testing.assert_close(e.candidates.probability.sum(1), torch.ones(1))
        value = e.candidates.expected(losses).sum()
    assert value > 0
    value.backward()
    assert_useful_gradients(extractor)


def estimate_scene(pipeline, scene, representation):
    image, masks, _ = scene
    with torch.no_grad():
        return pipeline(image[None], K[None], representation, masks=masks, image_index=torch.tensor([0, 0]))


def in_half_precision(representation):
    halved = copy.deepcopy(representation)
    halved.descriptors = halved.descriptors.half()
    return halved


@pytest.mark.parametrize("retriever", [TemplateRetriever(SoftAssignBow()), PatchVoteRetriever()])
def test_retrievers_and_descriptors_in_half_precision(scene, oracle_blob, blob, retriever):
    full = estimate_scene(make_pipeline(retriever=retriever), scene, oracle_blob)
    half = estimate_scene(make_pipeline(retriever=retriever), scene, in_half_precision(oracle_blob))
    for e in (full, half):
        assert e.valid.all()
        angle, distance = errors(e, scene[2])
        assert angle.max() < 2.0
        assert distance.max() < 0.05 * blob.diameter
        assert e.templates.similarity.dtype == e.correspondences.distance.dtype == torch.float32
    torch.testing.assert_close(half.templates.similarity, full.templates.similarity, rtol=0, atol=2e-3)
    refined = make_pipeline(retriever=retriever, refiner=FeaturemetricRefiner())
    e = estimate_scene(refined, scene, in_half_precision(oracle_blob))
    assert e.refined.valid.all()


def test_patch_votes_find_templates_seen_from_about_the_same_side(scene, oracle_blob):
    """Codes of true coordinates do not tell in which way up the object is, but they tell which side is seen."""
    e = estimate_scene(make_pipeline(retriever=PatchVoteRetriever()), scene, oracle_blob)
    seen = (e.crops.T_crop_from_camera @ scene[2])[:, 2, :3]
    cosine = seen @ oracle_blob.T_template_from_model[:, 2, :3].T
    rank = cosine.argsort(dim=1, descending=True).argsort(dim=1).gather(1, e.templates.index)
    assert (rank[:, 0] < 10).all()
    assert rank.max() < 30


class NearestTemplates(Retriever):
    """Knows the true poses in the crops and retrieves templates of about the same orientation."""

    def __init__(self, scene, num_templates=5):
        super().__init__(num_templates)
        image, masks, T_true = scene
        crops = PerspectiveCrop()(image[None], K[None], masks, image_index=torch.tensor([0, 0]))
        self.R = (crops.T_crop_from_camera @ T_true)[:, None, :3, :3]

    def forward(self, query, index):
        similarity = self.R.new_tensor(1.0) - rotation_angle(self.R, index.T_template_from_model[:, :3, :3])
        return select_templates(similarity, query.valid.any(dim=1), self.num_templates)


def test_cls_tokens_retrieve(scene, oracle_blob, blob, transformer):
    extractor, _, representation = transformer
    T, intrinsics = representation.T_template_from_model[:6], representation.K_template[:6]
    render = RaycastRenderer()(blob, T, intrinsics, (420, 420))
    pipeline = make_pipeline(
        extractor,
        retriever=ClsRetriever(3),
        crop=PerspectiveCrop(background="black"),
        hypotheses=TemplateHypotheses(),
    )
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("error")  # a bag of words is nothing that this retriever relies on
        e = pipeline(render.rgb, intrinsics, representation, masks=render.mask)
    assert (e.templates.index[:, 0] == torch.arange(6)).sum() >= 5
    assert e.valid.all()
    with pytest.raises(ValueError, match="the extractor gives no cls token"):
        estimate_scene(make_pipeline(retriever=ClsRetriever()), scene, oracle_blob)


def test_pose_of_the_top_template(scene, oracle_blob, blob):
    pipeline = make_pipeline(hypotheses=TemplateHypotheses(), retriever=NearestTemplates(scene))
    e = estimate_scene(pipeline, scene, oracle_blob)
    assert e.valid.all()
    assert (e.best == 0).all()
    assert torch.equal(e.score, e.templates.similarity[:, 0])
    assert (e.num_inliers == 0).all()
    assert e.correspondences is None
    assert e.hypotheses.inliers.shape == (2, 5, 0)
    angle, _ = errors(e, scene[2])
    # As far off as the nearest template, and not farther.
    torch.testing.assert_close(torch.deg2rad(angle), 1.0 - e.templates.similarity[:, 0], rtol=0, atol=0.02)
    # Across the viewing ray, the place is much better known than along it.
    centre = blob.bounds.mean(0).float()
    seen, true = (T[:, :3, :3] @ centre + T[:, :3, 3] for T in (e.T_camera_from_model, scene[2]))
    assert ((seen / seen[:, 2:] - true / true[:, 2:])[:, :2] * 600).abs().max() < 10
    assert (seen[:, 2] / true[:, 2] - 1).abs().max() < 0.1
    assert [r["status"] for r in pose_records(e)] == ["OK", "OK"]


@pytest.mark.parametrize("refine", ["best", "all"])
def test_pose_of_a_template_is_a_start_for_refiners(scene, oracle_blob, refine):
    settings = {"hypotheses": TemplateHypotheses(), "retriever": NearestTemplates(scene), "refine": refine}
    coarse = estimate_scene(make_pipeline(**settings), scene, oracle_blob)
    refined = estimate_scene(make_pipeline(**settings, refiner=FeaturemetricRefiner()), scene, oracle_blob)
    assert refined.refined.valid.all()
    if refine == "best":
        torch.testing.assert_close(refined.T_coarse, coarse.T_camera_from_model)
    before, after = errors(coarse, scene[2]), errors(refined, scene[2])
    assert (after[0] < 0.5 * before[0]).all()
    assert after[1].max() < 0.5 * before[1].max()


def test_poses_of_templates_alone_as_in_a_batch_and_unusable_masks(scene, oracle_blob, oracle_other):
    image, masks, _ = scene
    thin = torch.zeros(2, *SIZE, dtype=torch.bool)
    thin[1, 100, 100:400] = True
    all_masks = torch.cat([masks[:1], thin, masks[1:], masks[1:]])
    which = torch.tensor([0, 0, 0, 1, 0])
    pipeline = make_pipeline(hypotheses=TemplateHypotheses())
    with torch.no_grad():
        batch = pipeline(
            image[None],
            K[None],
            [oracle_blob, oracle_other],
            masks=all_masks,
            image_index=torch.zeros(5).long(),
            object_index=which,
        )
        alone = [
            pipeline(image[None], K[None], [oracle_blob, oracle_other][which[b]], masks=all_masks[b : b + 1])
            for b in range(5)
        ]
    expected = [PoseStatus.OK, PoseStatus.UNUSABLE_MASK, PoseStatus.NO_PATCHES, PoseStatus.OK, PoseStatus.OK]
    assert batch.status.tolist() == expected
    assert [int(e.status) for e in alone] == expected
    assert torch.isfinite(batch.T_camera_from_model).all()
    assert (batch.score[1:3] == 0).all()
    for b in (0, 3, 4):
        torch.testing.assert_close(
            batch.T_camera_from_model[b], alone[b].T_camera_from_model[0], rtol=1e-4, atol=1e-2
        )


class NothingFound(Retriever):
    """Retrieves no template, or but one."""

    def __init__(self, found):
        super().__init__(2)
        self.found = found

    def forward(self, query, index):
        B = len(query.valid)
        valid = torch.tensor([self.found, False]).expand(B, 2)
        similarity = torch.where(valid, 0.5, -torch.inf)
        return RetrievedTemplates(torch.zeros(B, 2).long(), similarity, valid)


def test_no_template(scene, oracle_blob):
    e = estimate_scene(
        make_pipeline(hypotheses=TemplateHypotheses(), retriever=NothingFound(False)), scene, oracle_blob
    )
    assert (e.status == PoseStatus.NO_TEMPLATE).all()
    assert not e.valid.any()
    assert (e.score == 0).all()
    assert torch.isfinite(e.T_camera_from_model).all()
    e = estimate_scene(
        make_pipeline(hypotheses=TemplateHypotheses(), retriever=NothingFound(True)), scene, oracle_blob
    )
    assert e.valid.all()
    assert e.hypotheses.status.tolist() == [[PoseStatus.OK, PoseStatus.NO_TEMPLATE]] * 2


def test_gradients_of_a_templates_pose_reach_the_camera(scene, oracle_blob):
    image, masks, T_true = scene
    camera = K[None].clone().requires_grad_()
    e = make_pipeline(hypotheses=TemplateHypotheses())(image[None], camera, oracle_blob, masks=masks[:1])
    ((e.T_camera_from_model - T_true[:1])[:, :3] ** 2).sum().backward()
    assert torch.isfinite(camera.grad).all()
    # A longer focal length puts the object farther away.
    assert camera.grad[0, 0, 0].abs() > 0


def test_starts_and_verification_choose_among_more_hypotheses(blob, oracle_blob):
    T = torch.stack([pose_at(blob, (300.0 + 20 * k, 230.0), 700.0, k) for k in range(3)])
    images = torch.stack([render_coordinate_image(CoordinateRenderer(), [blob], [t], K, SIZE) for t in T])
    masks = CoordinateRenderer()(blob, T, K[None], SIZE).mask
    coarse = make_pipeline(scorer=PatchVerification(), start=TemplateStart())
    with torch.no_grad():
        e = coarse(images, K.expand(3, 3, 3), oracle_blob, masks=masks)
        # RANSAC that draws one sample finds little; the templates' own poses are enough.
        poor = RansacPnp(iterations=1, polish_rounds=0)
        alone = make_pipeline(pnp=poor)(images, K.expand(3, 3, 3), oracle_blob, masks=masks)
        started = make_pipeline(pnp=poor, start=TemplateStart())(
            images, K.expand(3, 3, 3), oracle_blob, masks=masks
        )
        refined = make_pipeline(
            scorer=PatchVerification(), start=TemplateStart(), refiner=FeaturemetricRefiner(), refine="all"
        )(images, K.expand(3, 3, 3), oracle_blob, masks=masks)
        one = coarse(images[1:2], K[None], oracle_blob, masks=masks[1:2])
    degrees = torch.rad2deg(rotation_angle(e.T_camera_from_model[:, :3, :3], T[:, :3, :3]))
    assert (degrees < 3.0).all()
    assert torch.equal(e.score, e.hypotheses.score.gather(1, e.best[:, None])[:, 0])
    assert ((e.score > 0.5) & (e.score <= 1)).all()
    assert (started.num_inliers >= alone.num_inliers).all()
    assert (started.num_inliers > alone.num_inliers).any()
    # The scorer compares refined poses, too.
    assert torch.equal(refined.score, refined.refined.score.amax(1))
    torch.testing.assert_close(one.T_camera_from_model, e.T_camera_from_model[1:2], atol=1e-2, rtol=1e-4)


def test_pictures_in_half_precision(scene, blob):
    _, masks, T = scene
    extractor, bow = DenseSift(), SoftAssignBow(0.3)
    onboard = Onboarder(RaycastRenderer(), extractor, SuperFibonacci(8), VisualWords(16), bow)
    representation = onboard(blob, "blob")
    image = RaycastRenderer()(blob, T, K.expand(2, 3, 3), SIZE).rgb.amax(dim=0)
    pipeline = make_pipeline(extractor, retriever=TemplateRetriever(bow))
    full = estimate_scene(pipeline, (image, masks, T), representation)
    for dtype in (torch.float16, torch.bfloat16):
        e = estimate_scene(pipeline, (image.to(dtype), masks, T), representation)
        assert e.T_camera_from_model.dtype == e.query.pixels.dtype == torch.float32
        assert torch.equal(e.query.pixels, full.query.pixels)
        assert torch.equal(e.templates.index[:, 0], full.templates.index[:, 0])
        same = (e.correspondences.points_model == full.correspondences.points_model).all(dim=-1)
        assert same[:, 0].float().mean() > 0.7


def test_the_warning_of_other_settings_names_this_file(scene, oracle_blob):
    pipeline = make_pipeline(retriever=TemplateRetriever(SoftAssignBow(sigma=3.0)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        estimate_scene(pipeline, scene, oracle_blob)
    (warning,) = [w for w in caught if "was onboarded with bow=" in str(w.message)]
    assert warning.filename == __file__

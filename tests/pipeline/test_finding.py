import pytest
import torch
from torch import Tensor

from foundpose import DetectAndEstimate, FoundPose, MatchAndSolve
from foundpose.detection import CropScorer, Detector, Pictures, Proposals, Proposer, pad_proposals
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, intrinsics_matrix, make_transform, rotation_angle
from foundpose.matching import PatchMatcher
from foundpose.pipeline import PoseConfidence
from foundpose.pnp import RansacPnp
from foundpose.rendering import CoordinateRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import SoftAssignBow, TemplateRetriever
from foundpose.synthetic import random_rotation

SIZE = (480, 640)
K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)


class Known(Proposer):
    def __init__(self, masks: Tensor) -> None:
        super().__init__()
        self.masks = masks

    def forward(self, pictures: Pictures) -> Proposals:
        return pad_proposals([self.masks] * len(pictures.images))


@pytest.fixture(scope="module")
def scene(blob):
    """Two blobs in a picture of coordinates, their masks, halves of these, and an empty place."""
    generator = torch.Generator().manual_seed(5)
    places = torch.tensor([[-150.0, -70.0, 700.0], [150.0, 80.0, 800.0]])
    T = torch.stack([make_transform(random_rotation(generator).float(), place) for place in places])
    renderer = CoordinateRenderer()
    image = render_coordinate_image(renderer, [blob, blob], list(T), K, SIZE)
    masks = renderer(blob, T, K.expand(2, 3, 3), SIZE).mask
    halves = masks.clone()
    halves[0, :, : int(masks[0].nonzero()[:, 1].float().mean())] = False
    halves[1, : int(masks[1].nonzero()[:, 0].float().mean())] = False
    empty = torch.zeros(1, *SIZE, dtype=torch.bool)
    empty[0, 400:460, 20:90] = True
    return image, torch.cat([masks, halves, empty]), T


def finder(masks: Tensor, **changes: float) -> DetectAndEstimate:
    extractor = CoordinateCode()
    crop = PerspectiveCrop(background="black")
    detector = Detector(extractor, Known(masks), CropScorer(crop), overlap=0.9, **changes)
    hypotheses = MatchAndSolve(PatchMatcher(), RansacPnp())
    pipeline = FoundPose(crop, extractor, TemplateRetriever(SoftAssignBow()), hypotheses)
    return DetectAndEstimate(detector, pipeline, batch_size=2).eval()


@torch.no_grad()
def test_every_instance_once(scene, oracle_blob) -> None:
    image, masks, T = scene
    found = finder(masks)(image[None], K[None], oracle_blob, instances=None)
    assert found is not None
    t = found.estimates.T_camera_from_model[:, :3, 3]
    for true in T:
        # What is a half of an instance has nearly the instance's pose, and is no instance of its own.
        near = ((t - true[:3, 3]).norm(dim=1) < 30).nonzero().flatten()
        assert len(near) == 1
        R = found.estimates.T_camera_from_model[near[0], :3, :3]
        assert float(torch.rad2deg(rotation_angle(R, true[:3, :3]))) < 6
    assert torch.equal(found.score, found.detections.score * found.estimates.score)
    assert (found.score.diff() <= 0).all()
    assert bool(found.estimates.valid.all())


@torch.no_grad()
def test_as_many_as_asked_for(scene, oracle_blob) -> None:
    image, masks, _T = scene
    images, Ks = torch.stack([image, image]), K.expand(2, 3, 3)
    found = finder(masks)(images, Ks, [oracle_blob, oracle_blob], instances=[1, 2])
    assert found is not None
    pairs = list(
        zip(found.detections.image_index.tolist(), found.detections.object_index.tolist(), strict=True)
    )
    assert {pair: pairs.count(pair) for pair in pairs} == {(0, 0): 1, (0, 1): 2, (1, 0): 1, (1, 1): 2}
    assert [image for image, _ in pairs] == sorted(image for image, _ in pairs)
    alone = finder(masks)(image[None], K[None], oracle_blob, instances=2)
    assert alone is not None
    mine = torch.tensor([pair == (1, 1) for pair in pairs])
    torch.testing.assert_close(
        found.estimates.T_camera_from_model[mine], alone.estimates.T_camera_from_model, atol=1e-3, rtol=1e-4
    )


@torch.no_grad()
def test_nothing_to_be_found(scene, oracle_blob) -> None:
    image, masks, _ = scene
    assert finder(masks[:0])(image[None], K[None], oracle_blob) is None


@torch.no_grad()
def test_improbable_poses_are_no_instances(scene, oracle_blob) -> None:
    image, masks, _ = scene
    found = finder(masks)
    found.pipeline.confidence = PoseConfidence({}, -1.0)  # every pose: 27 %
    found.min_probability = 0.3
    assert found(image[None], K[None], oracle_blob) is None
    found.min_probability = 0.2
    assert found(image[None], K[None], oracle_blob) is not None


def test_gradients_reach_the_picture(scene, oracle_blob) -> None:
    image, masks, _ = scene
    image = image.clone().requires_grad_()
    found = finder(masks)(image[None], K[None], oracle_blob)
    assert found is not None
    found.detections.score.sum().backward()
    assert image.grad is not None
    assert float(image.grad.abs().sum()) > 0


def test_refusals(scene, oracle_blob) -> None:
    image, masks, _ = scene
    for instances, match in ((0, "at least 1"), ([1, 2], "one for each"), (9, "max_detections")):
        with pytest.raises(ValueError, match=match):
            finder(masks)(image[None], K[None], oracle_blob, instances=instances)
    with pytest.raises(ValueError, match="batch_size"):
        DetectAndEstimate(finder(masks).detector, finder(masks).pipeline, batch_size=0)

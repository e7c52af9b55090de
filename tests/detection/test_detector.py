from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.detection import (
    CropScorer,
    DensePatches,
    Detector,
    MeanDescriptorScorer,
    Pictures,
    Proposals,
    Proposer,
    RegionProposer,
    pad_proposals,
)
from foundpose.detection.scoring import ViewsOfTemplates
from foundpose.features import PatchFeatures
from foundpose.geometry import PerspectiveCrop
from foundpose.representation import ObjectRepresentation
from tests.detection.conftest import SIDE, Colors, K, Scene


class Known(Proposer):
    """Proposes the same masks of every picture."""

    def __init__(self, masks: Tensor) -> None:
        super().__init__()
        self.masks = masks

    def forward(self, pictures: Pictures) -> Proposals:
        return pad_proposals([self.masks] * len(pictures.images))


def crop_scorer(**changes: Any) -> CropScorer:
    return CropScorer(PerspectiveCrop(size=SIDE, background="black"), **changes)


def detector(masks: Tensor, **changes: object) -> Detector:
    settings: dict = {"extractor": Colors(), "proposer": Known(masks), "scorer": crop_scorer()}
    return Detector(**(settings | changes)).eval()


def distractors(scene: Scene) -> Tensor:
    """The three objects, a part of the first, and two pieces of background."""
    part = scene.masks[0].clone()
    part[:, : int(scene.masks[0].nonzero()[:, 1].float().mean())] = False
    grey = torch.zeros(2, *scene.masks.shape[1:], dtype=torch.bool)
    grey[0, 150:200, 20:70] = True
    grey[1, 20:60, 260:310] = True
    return torch.cat([scene.masks, part[None], grey])


def test_views_of_templates(scene: Scene) -> None:
    obj = scene.objects["red"]
    views = ViewsOfTemplates()(obj)
    for t in range(obj.num_templates):
        rows = torch.arange(int(obj.template_offsets[t]), int(obj.template_offsets[t + 1]))
        z = obj.read_descriptors(rows).mean(dim=0)
        torch.testing.assert_close(views.means[t], z @ obj.projection.components + obj.projection.mean)
        assert torch.equal(views.shapes[t].nonzero()[:, 0], obj.patch_index[rows].long())


def shapes_overlap(inside: Tensor, obj: ObjectRepresentation) -> Tensor:
    """Intersection over union (T,) of a region's cells (10, 10) and each template's, by sets."""
    mine = set(inside.flatten().nonzero()[:, 0].tolist())
    overlaps = []
    for t in range(obj.num_templates):
        cells = obj.patch_index[int(obj.template_offsets[t]) : int(obj.template_offsets[t + 1])]
        theirs = set(cells.tolist())
        overlaps.append(len(mine & theirs) / len(mine | theirs))
    return torch.tensor(overlaps)


def with_lead(similarity: Tensor) -> Tensor:
    """Similarities (P, 3) of three objects, and half of each one's lead over the best of the others."""
    lead = [similarity[:, o] - similarity[:, [p for p in range(3) if p != o]].amax(1) for o in range(3)]
    return similarity + 0.5 * torch.stack(lead, dim=1)


class InnerColors(Colors):
    """Tells in its global descriptor how much it was asked to leave out."""

    leaves_border = True

    def forward(self, images: Tensor, border: int = 0) -> PatchFeatures:
        features = super().forward(images)
        assert features.cls is not None
        return features._replace(cls=features.cls + border)


@pytest.mark.parametrize(("margin", "border"), [(None, 0), (1, 1), (0, 2)])
def test_crop_scores_as_written_out(margin: int | None, border: int, scene: Scene) -> None:
    """The definition, for one region and object at a time; the object fills six of ten patches."""
    extractor = InnerColors()
    scorer = crop_scorer(views=3, patches=0.25, rivals=0.5, shape=0.3, margin=margin)
    masks = distractors(scene)
    objects = list(scene.objects.values())
    proposals = pad_proposals([masks])
    wanted = torch.ones(1, len(masks), len(objects), dtype=torch.bool)
    wanted[0, 2, 1] = False
    score = scorer(Pictures(scene.image[None], K[None]), proposals, objects, extractor, wanted)
    expected = torch.zeros(len(masks), len(objects))
    crop = PerspectiveCrop(size=SIDE, background="black")
    for i, mask in enumerate(masks):
        cut = crop(scene.image[None], K[None], mask[None])
        said = extractor(cut.images, border)
        inside = F.avg_pool2d(cut.masks[None], 2, 1)[0, 0, 6::14, 6::14] > 0.5  # the patches' centres, at 6.5
        mean = said.patches[0][:, inside].mean(dim=1)
        for o, obj in enumerate(objects):
            of_patches = F.cosine_similarity(mean[None], ViewsOfTemplates()(obj).means)
            of_cls = F.cosine_similarity(said.cls, obj.template_cls)
            of_views = (0.25 * of_patches + 0.75 * of_cls + 0.3 * shapes_overlap(inside, obj)) / 1.3
            expected[i, o] = of_views.sort(descending=True).values[:3].mean()
    expected = torch.where(wanted[0], with_lead(expected), torch.zeros(()))
    torch.testing.assert_close(score[0], expected, atol=1e-5, rtol=1e-5)


def test_the_quick_choice_as_written_out(scene: Scene) -> None:
    """With shapes of crops of half the templates' size."""
    masks, objects = distractors(scene), list(scene.objects.values())
    crop = PerspectiveCrop(size=SIDE // 2, antialias=False)
    scorer = MeanDescriptorScorer(views=2, rivals=0.5, shape=0.4, crop=crop)
    maps = DensePatches(scales=[2.0], size=SIDE, margin=1)(scene.image[None], Colors())
    wanted = torch.ones(1, len(masks), len(objects), dtype=torch.bool)
    pictures = Pictures(scene.image[None], K[None], maps)
    score = scorer(pictures, pad_proposals([masks]), objects, Colors(), wanted)
    expected = torch.zeros(len(masks), len(objects))
    for i, mask in enumerate(masks):
        share = maps[0].share_of(mask[None])[0]
        mean = (maps[0].descriptors[0] * share).sum((1, 2)) / share.sum()
        inside = crop(scene.image[None], K[None], mask[None]).masks[0, 3::7, 3::7] > 0.5
        for o, obj in enumerate(objects):
            of_patches = F.cosine_similarity(mean[None], ViewsOfTemplates()(obj).means)
            of_views = (of_patches + 0.4 * shapes_overlap(inside, obj)) / 1.4
            expected[i, o] = of_views.sort(descending=True).values[:2].mean()
    torch.testing.assert_close(score[0], with_lead(expected), atol=1e-4, rtol=1e-4)


def test_a_piece_of_an_object_has_not_its_shape(scene: Scene) -> None:
    masks = torch.stack([scene.masks[0], distractors(scene)[3]])
    leads = []
    for shape in (0.0, 0.5):
        scorer = crop_scorer(shape=shape, rivals=0.0)
        wanted = torch.ones(1, 2, 1, dtype=torch.bool)
        pictures = Pictures(scene.image[None], K[None])
        score = scorer(pictures, pad_proposals([masks]), [scene.objects["red"]], Colors(), wanted)[0, :, 0]
        leads.append(float(score[0] - score[1]))
    assert leads[1] > leads[0] + 0.02


def test_finds_every_instance_and_not_what_is_absent(scene: Scene) -> None:
    objects = [scene.objects[name] for name in ("red", "blue", "green")]
    found = detector(distractors(scene))(scene.image[None], K[None], objects)
    best = {o: found.masks[found.object_index == o] for o in range(3)}
    scores = {o: found.score[found.object_index == o] for o in range(3)}
    assert {i for i in range(3) if any(torch.equal(scene.masks[i], m) for m in best[0][:2])} == {0, 1}
    assert torch.equal(best[1][0], scene.masks[2])
    # The green object is not there, and what looks most like it does so less than the others look like themselves.
    assert float(scores[2].max()) < min(float(scores[0][1]), float(scores[1][0])) - 0.05


def test_overlapping_proposals_are_one_detection(scene: Scene) -> None:
    grown = F.max_pool2d(scene.masks[:1].float(), 3, 1, 1) > 0
    masks = torch.cat([scene.masks, grown])
    kept = detector(masks)(scene.image[None], K[None], scene.objects["red"])
    assert len(kept.score) == 3
    all_of_them = detector(masks, overlap=1.0)(scene.image[None], K[None], scene.objects["red"])
    assert len(all_of_them.score) == 4
    few = detector(masks, max_detections=2)(scene.image[None], K[None], scene.objects["red"])
    assert torch.equal(few.score, kept.score[:2])


def test_a_region_can_be_one_objects_only(scene: Scene) -> None:
    objects = list(scene.objects.values())
    found = detector(scene.masks, across_objects=True)(scene.image[None], K[None], objects)
    assert len(found.score) == 3
    names = list(scene.objects)
    for mask, label in zip(found.masks, found.object_index.tolist(), strict=True):
        i = next(i for i in range(3) if torch.equal(scene.masks[i], mask))
        assert names[label] == scene.labels[i]


def test_no_proposals(scene: Scene) -> None:
    found = detector(scene.masks[:0])(scene.image[None], K[None], scene.objects["red"])
    assert found.masks.shape == (0, *scene.masks.shape[1:])
    assert len(found.score) == 0


def test_pictures_alone_as_in_a_batch(scene: Scene) -> None:
    images = torch.stack([scene.image, scene.image.flip(-1)])
    objects = [scene.objects["red"], scene.objects["blue"]]
    proposer = RegionProposer(components=4, min_patches=8)
    dense = DensePatches(scales=[2.0], size=SIDE, margin=1)
    finder = detector(
        scene.masks,
        proposer=proposer,
        dense=dense,
        preselection=MeanDescriptorScorer(),
        candidates=6,
    )
    together = finder(images, K.expand(2, 3, 3), objects)
    assert set(together.image_index.tolist()) == {0, 1}
    for n in range(2):
        alone = finder(images[n : n + 1], K[None], objects)
        mine = together.image_index == n
        assert torch.equal(alone.object_index, together.object_index[mine])
        assert torch.equal(alone.masks, together.masks[mine])
        torch.testing.assert_close(alone.score, together.score[mine], atol=1e-5, rtol=1e-5)


def test_without_a_segmenter(scene: Scene) -> None:
    """From the picture alone: regions, a quick choice, crops."""
    objects = [scene.objects[name] for name in ("red", "blue", "green")]
    finder = detector(
        scene.masks,
        proposer=RegionProposer(components=4, min_patches=8),
        dense=DensePatches(scales=[2.0], size=SIDE, margin=1),
        preselection=MeanDescriptorScorer(),
        candidates=8,
    )
    found = finder(scene.image[None], K[None], objects)
    best = found.masks[(found.object_index == 1).nonzero()[0, 0]]
    assert float((best & scene.masks[2]).sum() / (best | scene.masks[2]).sum()) > 0.6


def test_memory_does_not_grow_with_the_proposals(scene: Scene) -> None:
    """A thousand regions are cropped and described a few at a time."""
    sizes = []
    scorer = crop_scorer(batch_size=16)
    scorer.crop.register_forward_hook(lambda module, args, output: sizes.append(len(output.images)))
    # Half of the size of everything, so that a thousand take seconds.
    masks = torch.zeros(1000, *scene.masks.shape[1:], dtype=torch.bool)
    for i in range(1000):
        masks[i, i % 200 : i % 200 + 30, i % 280 : i % 280 + 30] = True
    with torch.no_grad():
        found = detector(masks, scorer=scorer, max_detections=1000)(
            scene.image[None], K[None], scene.objects["red"]
        )
    assert sum(sizes) == 1000
    assert max(sizes) == 16
    assert 0 < len(found.score) < 1000


def test_scores_have_gradients(scene: Scene) -> None:
    image = scene.image.clone().requires_grad_()
    found = detector(scene.masks)(image[None], K[None], scene.objects["red"])
    found.score.sum().backward()
    assert image.grad is not None
    assert float(image.grad[:, scene.masks.any(0)].abs().sum()) > 0
    assert float(image.grad[:, :20, 150:170].abs().sum()) == 0


def test_refusals(scene: Scene) -> None:
    finder = detector(scene.masks)
    red = scene.objects["red"]
    with pytest.raises(ValueError, match="images must be floating point"):
        finder(scene.image, K[None], red)
    with pytest.raises(ValueError, match="K must have shape"):
        finder(scene.image[None], K, red)
    with pytest.raises(ValueError, match="objects is empty"):
        finder(scene.image[None], K[None], [])
    with pytest.raises(ValueError, match="give dense"):
        detector(scene.masks, preselection=MeanDescriptorScorer())
    with pytest.raises(ValueError, match="overlap must be in"):
        detector(scene.masks, overlap=2.0)
    with pytest.raises(ValueError, match="views must be at least 1"):
        crop_scorer(views=0)
    with pytest.raises(ValueError, match="shape must be at least 0, got -1"):
        MeanDescriptorScorer(shape=-1.0)

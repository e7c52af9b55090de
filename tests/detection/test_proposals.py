import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foundpose.bop import BopError, encode_segmentation
from foundpose.detection import (
    DensePatches,
    FileProposer,
    Pictures,
    RegionProposer,
    mask_overlaps,
    pad_proposals,
    proposals_from_boxes,
    suppress,
)
from tests.detection.conftest import PICTURE, Colors, K, Scene


def overlap(a: Tensor, b: Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@settings(max_examples=50)
@given(st.integers(0, 10_000), st.integers(0, 12), st.floats(0, 1))
def test_suppression_as_the_definition_says(seed: int, count: int, most: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(count, 6, 7, generator=generator) > 0.5
    score = torch.randint(0, 4, (count,), generator=generator).float()
    overlaps = mask_overlaps(masks)
    kept: list[int] = []
    for i in sorted(range(count), key=lambda i: -float(score[i])):
        if all(bool(overlaps[i, k] <= most) for k in kept):
            kept.append(i)
    assert suppress(overlaps, score, most).tolist() == kept


def test_overlaps() -> None:
    masks = torch.rand(5, 30, 40, generator=torch.Generator().manual_seed(0)) > 0.5
    ours = mask_overlaps(masks)
    for i in range(5):
        for j in range(5):
            assert float(ours[i, j]) == pytest.approx(overlap(masks[i], masks[j]))
    assert mask_overlaps(torch.zeros(0, 30, 40, dtype=torch.bool)).shape == (0, 0)
    # Large masks are looked at on a coarser grid.
    u = torch.arange(1200)
    large = torch.stack([(u < 700).expand(900, -1), (u > 300).expand(900, -1)])
    assert float(mask_overlaps(large)[0, 1]) == pytest.approx(overlap(*large), abs=0.01)


def test_padding() -> None:
    some = torch.ones(2, 4, 5, dtype=torch.bool)
    proposals = pad_proposals(
        [some[:0], some, some[:1]], [torch.zeros(0), torch.tensor([0.3, 0.2]), torch.ones(1)]
    )
    assert proposals.valid.tolist() == [[False, False], [True, True], [True, False]]
    assert proposals.score.flatten().tolist() == pytest.approx([0, 0, 0.3, 0.2, 1, 0])


def test_boxes() -> None:
    proposals = proposals_from_boxes([torch.tensor([[0.5, 1.5, 3.5, 4.5], [50.0, 50.0, 60.0, 60.0]])], 10, 12)
    assert int(proposals.masks[0, 0].sum()) == 9
    assert bool(proposals.masks[0, 0, 2:5, 1:4].all())
    assert proposals.valid.tolist() == [[True, False]]  # the other lies outside the picture


def test_regions_find_the_objects(scene: Scene) -> None:
    dense = DensePatches(scales=[2.0], size=140, margin=1)
    pictures = Pictures(scene.image[None], K[None], dense(scene.image[None], Colors()))
    proposals = RegionProposer(components=4, min_patches=8)(pictures)
    assert bool(proposals.valid.all())
    assert proposals.masks.shape[2:] == PICTURE
    for mask in scene.masks:
        assert max(overlap(mask, found) for found in proposals.masks[0]) > 0.75
    sizes = proposals.masks[0].flatten(1).sum(1)
    assert int(sizes.max()) < 0.2 * scene.image[0].numel()
    assert int(sizes.min()) > 150


def test_regions_alone_as_in_a_batch(scene: Scene) -> None:
    images = torch.stack([scene.image, scene.image.flip(-1)])
    dense, proposer = (
        DensePatches(scales=[1.0], size=140, margin=1),
        RegionProposer(components=4, min_patches=4),
    )
    together = proposer(Pictures(images, K.expand(2, 3, 3), dense(images, Colors())))
    for n in range(2):
        one = images[n : n + 1]
        alone = proposer(Pictures(one, K[None], dense(one, Colors())))
        assert torch.equal(alone.masks[0], together.masks[n][together.valid[n]])


def test_regions_of_two_scales(scene: Scene) -> None:
    """All of the first, and of the second those that are not among them."""
    images = torch.stack([scene.image, torch.zeros_like(scene.image)])
    maps = DensePatches(scales=[1.0, 2.0], size=140, margin=1)(images, Colors())
    proposer = RegionProposer(components=4, min_patches=4)
    first, second, both = (
        proposer(Pictures(images, K.expand(2, 3, 3), part)) for part in (maps[:1], maps[1:], maps)
    )
    for n in range(2):
        a, b, joined = (found.masks[n][found.valid[n]] for found in (first, second, both))
        assert torch.equal(joined[: len(a)], a)
        known = {mask.numpy().tobytes() for mask in b}
        assert all(mask.numpy().tobytes() in known for mask in joined[len(a) :])
        x, y = joined[len(a) :].flatten(1).double(), a.flatten(1).double()
        shared = x @ y.T
        assert (shared / (x.sum(1)[:, None] + y.sum(1) - shared)).max() < 0.8
    assert int(both.valid[0].sum()) > int(first.valid[0].sum())


def test_a_picture_without_regions() -> None:
    image = torch.zeros(1, 3, 60, 60)
    dense = DensePatches(scales=[1.0], size=140, margin=1)
    proposals = RegionProposer(min_patches=200)(Pictures(image, K[None], dense(image, Colors())))
    assert proposals.masks.shape == (1, 0, 60, 60)


def test_regions_need_descriptors() -> None:
    with pytest.raises(ValueError, match="DensePatches"):
        RegionProposer()(Pictures(torch.zeros(1, 3, 60, 60), K[None]))
    with pytest.raises(ValueError, match="max_share must be in"):
        RegionProposer(max_share=0.0)


def test_proposals_of_a_file(scene: Scene, tmp_path) -> None:
    path = tmp_path / "proposals.json"
    entries = [
        {"scene_id": 1, "image_id": 7, "score": 0.4, "segmentation": encode_segmentation(scene.masks[0])},
        {"scene_id": 1, "image_id": 7, "bbox": [10, 20, 30, 40]},
        {"scene_id": 1, "image_id": 8, "bbox": [0, 0, 5, 5]},
    ]
    path.write_text(json.dumps(entries))
    pictures = Pictures(torch.zeros(3, 3, *PICTURE), K.expand(3, 3, 3), names=[(1, 7), (1, 9), (1, 8)])
    proposals = FileProposer(path)(pictures)
    assert proposals.valid.tolist() == [[True, True], [False, False], [True, False]]
    assert torch.equal(proposals.masks[0, 0], scene.masks[0])
    assert int(proposals.masks[0, 1].sum()) == 1200
    assert bool(proposals.masks[0, 1, 20:60, 10:40].all())
    assert proposals.score[0].tolist() == pytest.approx([0.4, 1.0])
    with pytest.raises(ValueError, match="names"):
        FileProposer(path)(pictures._replace(names=None))
    with pytest.raises(BopError, match="entry 0"):
        FileProposer(path)(pictures._replace(images=torch.zeros(3, 3, 100, 100)))


@pytest.mark.parametrize(
    "entry", [{}, {"scene_id": 1, "image_id": 1}, {"scene_id": 1, "image_id": 1, "bbox": [1, 2]}]
)
def test_files_that_cannot_be_right(entry: dict, tmp_path) -> None:
    path = tmp_path / "proposals.json"
    path.write_text(json.dumps([entry]))
    with pytest.raises(BopError, match="entry 0"):
        FileProposer(path)
    path.write_text("{}")
    with pytest.raises(BopError, match="list"):
        FileProposer(path)
    with pytest.raises(FileNotFoundError):
        FileProposer(tmp_path / "none.json")

import json
import pickle

import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask

from foundpose.bop import (
    BopDataset,
    BopError,
    Instance,
    Target,
    decode_segmentation,
    detected_instances,
    ground_truth_instances,
)


def run_lengths(mask: np.ndarray) -> list[int]:
    """Column by column, starting with the number of pixels outside."""
    flat = mask.flatten(order="F")
    edges = np.flatnonzero(np.diff(flat.astype(np.int8))) + 1
    counts = np.diff([0, *edges, flat.size]).tolist()
    return [0, *counts] if flat[0] else counts


@pytest.mark.parametrize("share", [0.0, 0.003, 0.4, 0.997, 1.0])
@pytest.mark.parametrize("size", [(6, 9), (1, 1), (480, 640)])
def test_run_lengths_are_column_major(rng, size, share):
    mask = rng.random(size) < share
    if size[0] > 100:
        mask[100:300, 50:600] = True
    expected = torch.from_numpy(mask)
    assert torch.equal(decode_segmentation({"size": [*size], "counts": run_lengths(mask)}), expected)
    packed = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"]
    for counts in (packed, packed.decode()):
        assert torch.equal(decode_segmentation({"size": [*size], "counts": counts}), expected)


PACKED = coco_mask.encode(np.asfortranarray(np.eye(60, 80, dtype=np.uint8)))["counts"].decode()


@pytest.mark.parametrize(
    ("size", "counts", "message"),
    [
        ([6, 9], [1, 2], "run lengths cover 3 pixels, the size says 6x9"),
        ([6, 9], [55, -1], "counts must be whole numbers of at least 0"),
        ([6, 9], [54.0], "counts must be whole numbers"),
        ([6, 9], 5, "counts must be a string or a list, got int"),
        ([6, 9], PACKED, "do not cover the 6x9 pixels that the size says"),
        # pycocotools reads and writes beyond its memory in these cases.
        ([60, 80], "", "counts is cut off"),
        ([60, 80], PACKED + "o", "counts is cut off"),
        ([60, 80], PACKED[: len(PACKED) // 2], "do not cover the 60x80 pixels that the size says"),
        ([60, 80], PACKED + PACKED, "do not cover the 60x80 pixels"),
        ([60, 80], "hello world", "characters that do not belong"),
        ([60, 80], "o" * 40 + "7", "characters that do not belong"),
        ([60, 80], "Ω", "cut off"),
        ([-60, -80], PACKED, r"size must be \[height, width\]"),
        (["60", 80], PACKED, r"size must be \[height, width\]"),
        (7, PACKED, r"size must be \[height, width\], got 7"),
    ],
)
def test_broken_run_lengths(size, counts, message):
    with pytest.raises(BopError, match=message):
        decode_segmentation({"size": size, "counts": counts})


def test_run_lengths_without_a_size():
    with pytest.raises(BopError, match="not a COCO segmentation"):
        decode_segmentation({"counts": [1]})


def test_ground_truth_and_best_detections(tiny_bop):
    dataset = BopDataset(tiny_bop)
    truth = ground_truth_instances(dataset)
    path = tiny_bop / "detections" / "cnos-fastsam"
    best = detected_instances(dataset, path)
    assert [(i.scene_id, i.im_id, i.obj_id) for i in best] == [(i.scene_id, i.im_id, i.obj_id) for i in truth]
    assert all(i.score == 0.9 and i.time == 0.25 for i in best)
    for a, b in zip(truth, best, strict=True):
        assert torch.equal(a.mask(dataset), b.mask(dataset))
    several = detected_instances(dataset, path, masks_per_instance=5)
    assert [i.score for i in several] == [0.9, 0.4] * 3
    assert not several[1].mask(dataset).any()
    # The list of run lengths in the file is packed.
    assert isinstance(several[1].segmentation["counts"], bytes)
    assert pickle.loads(pickle.dumps(several)) == several
    # Targets of one's own: in their order, also without a detection.
    chosen = [Target(1, 2, 1, 1), Target(1, 0, 2, 1), Target(1, 0, 1, 2)]
    assert [(i.im_id, i.score) for i in detected_instances(dataset, path, chosen)] == [
        (2, 0.9),
        (0, 0.9),
        (0, 0.4),
    ]


def detection(im_id=0, obj_id=1, score=0.5, time=0.1, pixels=1, **more):
    """A detection whose mask has ``pixels`` pixels, which tells it from others."""
    segmentation = {"size": [480, 640], "counts": [0, pixels, 480 * 640 - pixels]}
    ids = {"scene_id": 1, "image_id": im_id, "category_id": obj_id}
    return {**ids, "score": score, "time": time, "segmentation": segmentation, "bbox": [0, 0, 1, 1], **more}


def test_the_best_of_each_target_are_found_in_any_order(tiny_bop, tmp_path, rng):
    dataset = BopDataset(tiny_bop)
    scores = rng.integers(0, 12, 200) / 8 - 0.3
    objects, images = rng.integers(1, 3, 200), rng.integers(0, 4, 200)
    entries = [detection(int(images[i]), int(objects[i]), scores[i], 0.5, i + 1) for i in range(200)]
    path = tmp_path / "many.json"
    path.write_text(json.dumps(entries, indent=2))

    def reference(im_id, obj_id, count):
        found = [i for i in range(200) if images[i] == im_id and obj_id in (None, objects[i])]
        return sorted(found, key=lambda i: (-scores[i], i))[:count]

    def names(instances):
        return [int(i.mask(dataset).sum()) - 1 for i in instances]

    targets = [Target(1, 2, 2, 3), Target(1, 0, 1, 1)]
    got = detected_instances(dataset, path, targets, masks_per_instance=5)
    assert names(got) == reference(2, 2, 15) + reference(0, 1, 5)
    by_image = [Target(1, 1, None, None), Target(1, 0, None, None)]
    for limit in (1, 7, 100, None):
        got = detected_instances(dataset, path, by_image, max_per_image=limit)
        assert names(got) == reference(1, None, limit) + reference(0, None, limit)
        assert [i.obj_id for i in got] == [objects[k] for k in names(got)]


def test_time_and_score_are_carried_through(tiny_bop, tmp_path):
    path = tmp_path / "one.json"
    plain = detection(score=0.1234567890123, time=3.25)
    del plain["bbox"], plain["time"]
    path.write_text(json.dumps([plain, detection(im_id=1, obj_id=2, score=-2, time=3.25)]))
    got = detected_instances(BopDataset(tiny_bop), path)
    assert [(i.score, i.time) for i in got] == [(0.1234567890123, 0.0), (-2.0, 3.25)]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([{"scene_id": 1, "image_id": 2}], "entry 0 lacks or misspells a field: KeyError"),
        ([detection(), 3], "entry 1 lacks or misspells"),
        ([detection(im_id="0")], "entry 0 lacks or misspells .* whole numbers"),
        ([detection(score=None)], "entry 0 lacks or misspells"),
        ([detection(score=float("nan"))], "entry 0: score must be finite, got nan"),
        ([detection(score=float("inf"))], "entry 0: score must be finite, got inf"),
        ([detection(time=-1)], "entry 0: time must be seconds, at least 0, got -1.0"),
        ([detection(), detection(obj_id=3)], r"entry 1 is of object 3; the dataset has \[1, 2\]"),
        # An image that no target wants counts as well.
        ([detection(im_id=77, obj_id=3)], r"entry 0 is of object 3"),
        (
            [detection(segmentation={"size": [480, 640], "counts": [7]})],
            "entry 0: run lengths cover 7 pixels",
        ),
        ({"annotations": []}, "must hold a JSON list of detections, it holds dict"),
    ],
)
def test_bad_detections(tiny_bop, tmp_path, entries, message):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(entries))
    with pytest.raises(BopError, match=f"bad.json.*{message}"):
        detected_instances(BopDataset(tiny_bop), path)


BROKEN = ["", "  \n", "[", "[D", "[D,]", "[,D]", "[D D]", '[D, {"a": }]', "[D] x", "[D]]", "[D, tru]", "[D}"]


@pytest.mark.parametrize("text", BROKEN)
def test_broken_json_of_detections_names_the_place(tiny_bop, tmp_path, text):
    text = text.replace("D", json.dumps(detection()))
    (tmp_path / "broken.json").write_text(text)
    with pytest.raises(json.JSONDecodeError):
        json.loads(text)
    with pytest.raises(BopError, match=r"broken\.json is not valid JSON: .*line \d column \d"):
        detected_instances(BopDataset(tiny_bop), tmp_path)


@pytest.mark.parametrize("text", ["[]", " [ ] \n", "\ufeff[]"])
def test_no_detections(tiny_bop, tmp_path, text):
    (tmp_path / "none.json").write_text(text, encoding="utf-8")
    assert detected_instances(BopDataset(tiny_bop), tmp_path) == []


def test_bad_arguments(tiny_bop, tmp_path):
    dataset = BopDataset(tiny_bop)
    with pytest.raises(FileNotFoundError, match="is missing"):
        detected_instances(dataset, tmp_path / "none.json")
    with pytest.raises(FileNotFoundError, match="expected one JSON file"):
        detected_instances(dataset, tmp_path)
    with pytest.raises(ValueError, match="masks_per_instance must be at least 1, got 0"):
        detected_instances(dataset, tmp_path / "bad.json", masks_per_instance=0)
    with pytest.raises(ValueError, match="max_per_image must be at least 1 or null, got 0"):
        detected_instances(dataset, tmp_path / "bad.json", max_per_image=0)


def test_mask_of_another_size_or_broken(tiny_bop):
    dataset = BopDataset(tiny_bop)
    small = Instance(1, 2, 1, 0.5, 0.0, {"size": [60, 80], "counts": PACKED})
    with pytest.raises(
        BopError, match=r"object 1 in image 2 of scene 1: a mask of 80x60 px, .* has 640x480 px"
    ):
        small.mask(dataset)
    cut = Instance(1, 2, 1, 0.5, 0.0, {"size": [480, 640], "counts": PACKED + "o"})
    with pytest.raises(BopError, match=r"object 1 in image 2 of scene 1: counts is cut off"):
        cut.mask(dataset)


def test_detections_of_lmo(lmo_root):
    dataset = BopDataset(lmo_root)
    targets = dataset.targets()
    instances = detected_instances(dataset, lmo_root / "detections" / "cnos-fastsam")
    assert {(i.scene_id, i.im_id, i.obj_id) for i in instances} == {t[:3] for t in targets}
    assert len(instances) == len(targets)
    assert all(i.mask(dataset).any() for i in instances[:20])

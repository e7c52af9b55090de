import json
import shutil

import numpy as np
import pytest
from PIL import Image
from pycocotools import mask as coco_mask

from foundpose.bop import BopDataset, BopError, detection_scores

SIZE = (100, 120)


def square(x, y, width=20, height=20):
    mask = np.zeros(SIZE, dtype=np.uint8)
    mask[y : y + height, x : x + width] = 1
    return mask


@pytest.fixture(scope="module")
def squares(tmp_path_factory):
    """Two images of squares with sides of 20 px; of object 2 the lower half is hidden."""
    root = tmp_path_factory.mktemp("squares") / "squares"
    (root / "models").mkdir(parents=True)
    (root / "models/models_info.json").write_text(json.dumps({str(k): {"diameter": 1.0} for k in (1, 2, 3)}))
    scene = root / "test/000001"
    for folder in ("rgb", "mask", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    truth = {  # object, visible fraction, whole, visible
        3: [(1, 1.0, square(10, 10), square(10, 10)), (1, 0.05, square(60, 10), square(60, 10, 20, 1))],
        8: [(1, 1.0, square(10, 10), square(10, 10)), (2, 0.5, square(50, 50), square(50, 50, 20, 10))],
    }
    truth[8].append((3, 0.0, square(0, 0), 0 * square(0, 0)))
    pose = {"cam_R_m2c": np.eye(3).flatten().tolist(), "cam_t_m2c": [0.0, 0.0, 500.0]}
    camera = {"cam_K": [100.0, 0.0, 60.0, 0.0, 100.0, 50.0, 0.0, 0.0, 1.0]}
    entries = {str(i): [pose | {"obj_id": row[0]} for row in rows] for i, rows in truth.items()}
    infos = {str(i): [{"visib_fract": row[1]} for row in rows] for i, rows in truth.items()}
    for name, content in (("camera", dict.fromkeys(entries, camera)), ("gt", entries), ("gt_info", infos)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))
    for im_id, rows in truth.items():
        Image.new("RGB", SIZE[::-1]).save(scene / f"rgb/{im_id:06d}.png")
        for index, (*_, whole, visible) in enumerate(rows):
            for folder, mask in (("mask", whole), ("mask_visib", visible)):
                Image.fromarray(255 * mask).save(scene / folder / f"{im_id:06d}_{index:06d}.png")
    targets = [{"scene_id": 1, "im_id": i, "obj_id": 1, "inst_count": 1} for i in truth]
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return BopDataset(root)


def detection(im_id, obj_id, score, mask, **changes):
    packed = coco_mask.encode(np.asfortranarray(mask))
    segmentation = {"size": packed["size"], "counts": packed["counts"].decode()}
    box = coco_mask.toBbox(packed).tolist()
    ids = {"scene_id": 1, "image_id": im_id, "category_id": obj_id}
    return ids | {"score": score, "bbox": box, "segmentation": segmentation, "time": 0.5} | changes


FOUND = [
    detection(8, 1, 0.5, square(10, 10)),
    detection(3, 1, 0.7, square(90, 70)),  # wrong
    detection(3, 1, 0.8, square(60, 10, 20, 1), bbox=[60, 10, 20, 20]),  # the hidden one: not counted
    detection(3, 1, 0.9, square(12, 10)),  # shifted by 2 of 20 px: IoU 18 / 22 = 0.818
    detection(8, 2, 0.9, square(50, 50, 20, 10)),
]


def test_squares_by_hand(squares):
    """Object 1, two to find: at IoU 0.5 to 0.8 (7 of 10) right 0.9, wrong 0.7, right 0.5, else wrong, wrong, right.

    Recalls 1/2, 1/2, 1 at precisions 1, 1/2, 2/3: 51 recalls (0 to 0.5) at 1, 50 at 2/3. Else recall 1/2 at 1/3.
    The box of the hidden one's whole is not that of its visible row, so 0.8 is wrong there: precision 1/2 for 2/3
    and 1/4 for 1/3. Object 2: its visible half is found exactly. The box of the whole is twice as high, IoU 1/2:
    right at 0.5 alone.
    """
    above, below = (51 + 50 * 2 / 3) / 101, 51 / 3 / 101
    ignored, wrong = (above, (7 * above + 3 * below) / 10), (76 / 101, (7 * 76 + 3 * 51 / 4) / 1010)
    scores = detection_scores(squares, FOUND)
    assert scores.targets == {1: 2, 2: 1}
    assert scores.facts["annotations_not_counted"] == 1  # the other has no visible pixel
    for kind, (at_half, first), second in (
        ("segm", ignored, 1.0),
        ("bbox", ignored, 0.1),
        ("bbox_modal", wrong, 1.0),
    ):
        found = scores.kinds[kind]
        assert found.objects == pytest.approx({1: first, 2: second, 3: None}, abs=1e-9)
        recall = (0.85 + second) / 2  # of object 1: 7 of 10 times all, else half
        numbers = [found.AP, found.AP50, found.AP75, found.AR]
        expected = [(first + second) / 2, (at_half + 1) / 2, (at_half + (second == 1)) / 2, recall]
        assert numbers == pytest.approx(expected)
    content = scores.to_json()
    assert content["segm"]["objects"] == {str(k): v for k, v in scores.kinds["segm"].objects.items()}
    assert content["average_time_per_image"] == 0.5
    row = scores.table().splitlines()[-1].split()
    assert row[:3] == ["all", "3", f"{50 * (ignored[1] + 1):.1f}"]


def test_a_file_or_its_folder_says_the_same(squares, tmp_path):
    path = tmp_path / "found_squares-test.json"
    path.write_text(json.dumps(FOUND))
    expected = detection_scores(squares, FOUND).to_json()
    assert detection_scores(squares, path).to_json() == expected
    assert detection_scores(squares, tmp_path).to_json() == expected


def test_nothing_found_nothing_to_find(squares):
    empty = detection_scores(squares, [])
    assert (empty.kinds["segm"].AP, empty.facts["average_time_per_image"]) == (0.0, None)
    nothing = detection_scores(squares, FOUND, object_ids=[3])
    assert (nothing.kinds["bbox"].AP, nothing.targets) == (None, {})
    one = detection_scores(squares, FOUND, images=[(1, 8)], kinds=["segm"])
    assert (one.targets, list(one.kinds)) == ({1: 1, 2: 1}, ["segm"])
    assert one.kinds["segm"].objects == pytest.approx({1: 1.0, 2: 1.0, 3: None})


def test_ties_doubles_and_wrong_objects(squares):
    """Equal scores of an image keep the file's order: what comes first decides the precision of the other."""
    right, wrong = detection(8, 2, 0.5, square(50, 50, 20, 10)), detection(8, 2, 0.5, square(0, 0))
    for results, expected in (
        ([right, wrong], 1.0),
        ([wrong, right], 0.5),
        ([right, right], 1.0),
        ([detection(8, 1, 0.9, square(50, 50, 20, 10)), right], 1.0),  # another object's
        ([detection(3, 2, 0.9, square(50, 50, 20, 10)), right], 0.5),  # where there is none: wrong
    ):
        assert detection_scores(squares, results).kinds["segm"].objects[2] == pytest.approx(expected)


def test_entries_of_boxes_alone(squares):
    boxes = [{name: value for name, value in entry.items() if name != "segmentation"} for entry in FOUND]
    scores = detection_scores(squares, boxes)
    assert scores.kinds["bbox"] == detection_scores(squares, FOUND).kinds["bbox"]
    assert scores.kinds["segm"].AP == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"category_id": 9}, r"detections: entry 0 is of object 9; the dataset has \[1, 2, 3\]"),
        ({"bbox": [1, 2, 3]}, r"entry 0: bbox must be \[x, y, width, height\], got \[1, 2, 3\]"),
        ({"score": float("nan")}, "score must be finite"),
        ({"segmentation": {"size": [120, 100], "counts": [12000]}}, "entry 0: a mask of 100x120 px"),
    ],
)
def test_bad_entries_are_named(squares, change, message):
    with pytest.raises(BopError, match=message):
        detection_scores(squares, [FOUND[0] | change])


def test_what_is_missing_is_named(squares, tmp_path):
    with pytest.raises(ValueError, match="kinds must be some of segm, bbox, bbox_modal"):
        detection_scores(squares, FOUND, kinds=["masks"])
    root = shutil.copytree(squares.root, tmp_path / "copy")
    (root / "test/000001/scene_gt_info.json").unlink()
    with pytest.raises(BopError, match="visible fraction of object 1 in image 3 of scene 1 is not known"):
        detection_scores(BopDataset(root), FOUND)

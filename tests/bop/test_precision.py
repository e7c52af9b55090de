import json
import shutil

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from foundpose.bop import BopDataset, BopError, PoseResult, score_pose_detections
from foundpose.bop.precision import average_precision
from tests.bop.scored_dataset import make_scored_dataset, plain_errors, random_results

F, T = False, True
SIDES = (48.0, 64.0, 60.0)  # diagonal: 100


def at(x, y=0.0, z=630.0):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z])
    return pose


@pytest.fixture(scope="module")
def shifts(tmp_path_factory):
    """Two images of boxes that are never turned: a shift of d mm to the side is an error of d % and d px.

    The diagonal is 100 mm, so MSSD is d / 100 diameters. The nearest face is 30 mm before the centre, at a depth of
    600 mm, which is the focal length, and the image is 640 px wide: MSPD is d px.
    """
    root = tmp_path_factory.mktemp("shifts") / "shifts"
    for folder in ("models", "models_eval", "test/000001/rgb"):
        (root / folder).mkdir(parents=True)
    info = {str(k): {"diameter": 100.0} for k in (1, 2, 3)}
    for folder in ("models", "models_eval"):
        (root / folder / "models_info.json").write_text(json.dumps(info))
        for obj_id in (1, 2, 3):
            trimesh.creation.box(SIDES).export(root / folder / f"obj_{obj_id:06d}.ply")
    truth = {
        "0": [(1, at(0.0), 0.9), (1, at(0.0, 200.0), 0.05)],
        "1": [(1, at(-100.0), 0.1), (2, at(100.0), 1.0), (3, at(0.0), 0.09)],
    }
    entries = {
        im_id: [
            {"obj_id": k, "cam_R_m2c": pose[:3, :3].flatten().tolist(), "cam_t_m2c": pose[:3, 3].tolist()}
            for k, pose, _ in rows
        ]
        for im_id, rows in truth.items()
    }
    infos = {im_id: [{"visib_fract": visible} for *_, visible in rows] for im_id, rows in truth.items()}
    camera = {"cam_K": [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]}
    scene = root / "test/000001"
    for name, content in (("camera", dict.fromkeys(truth, camera)), ("gt", entries), ("gt_info", infos)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))
    for im_id in (0, 1):
        Image.new("RGB", (640, 480)).save(scene / f"rgb/{im_id:06d}.png")
    (root / "test_targets_bop24.json").write_text(json.dumps([{"scene_id": 1, "im_id": i} for i in (0, 1)]))
    return BopDataset(root, targets="test_targets_bop24.json")


def estimate(im_id, obj_id, score, pose):
    return PoseResult(1, im_id, obj_id, score, pose, 0.1)


FOUND = [
    estimate(1, 1, 0.6, at(-100.0)),  # right
    estimate(0, 1, 0.7, at(-200.0)),  # wrong
    estimate(0, 1, 0.8, at(0.0, 200.0)),  # matches what is hidden: not counted
    estimate(0, 1, 0.9, at(12.0)),  # right from 15 % and 15 px on
]


def test_average_precision_by_hand():
    """Recall 1/3 at precision 1, 2/3 at 2/3: 34 recalls (0 to 0.33) at 1, 33 (0.34 to 0.66) at 2/3, 34 at 0."""
    right = torch.tensor([T, F, T, F])
    everything = torch.ones(4, dtype=torch.bool)
    assert float(average_precision(right, everything, 3)) == pytest.approx((34 + 33 * 2 / 3) / 101)
    # Without the second, which is wrong: precision 1 up to 2/3.
    assert float(average_precision(right, torch.tensor([T, F, T, T]), 3)) == pytest.approx(67 / 101)
    # A later, better precision counts at the recalls before it: 1/2 at all recalls up to 1/2 of two targets.
    assert float(average_precision(torch.tensor([F, T]), everything[:2], 2)) == pytest.approx(51 / 2 / 101)
    batch = average_precision(torch.stack([right, ~right]), everything, 3)
    assert batch.tolist() == [float(average_precision(x, everything, 3)) for x in (right, ~right)]
    assert float(average_precision(right[:0], right[:0], 3)) == 0.0
    assert float(average_precision(everything, everything, 4)) == 1.0
    assert float(average_precision(everything, ~everything, 4)) == 0.0


def test_detections_by_hand(shifts):
    """Object 1, two to find. At 15 % (px) and above: right 0.9, wrong 0.7, right 0.6.

    Recalls 1/2, 1/2, 1 at precisions 1, 1/2, 2/3: 51 recalls (0 to 0.5) at 1, 50 at 2/3. At 5 % and 10 %, wrong 0.9,
    wrong 0.7, right 0.6: recall 1/2 at precision 1/3. Object 2 has nothing found, object 3 nothing to find.
    """
    above, below = (51 + 50 * 2 / 3) / 101, 51 / 3 / 101
    expected = (8 * above + 2 * below) / 10
    scores = score_pose_detections(shifts, FOUND)
    assert scores.targets == {1: 2, 2: 1}
    for name in ("mssd", "mspd"):
        assert scores.precisions[name][1].tolist() == pytest.approx([below] * 2 + [above] * 8)
        assert scores.average(name, 1) == pytest.approx(expected)
        assert scores.average(name, 2) == 0.0
        assert scores.average(name) == pytest.approx(expected / 2)
    content = scores.to_json()
    assert content["AP"] == pytest.approx(expected / 2)
    assert content["objects"]["1"]["AP_MSPD"] == pytest.approx(expected)
    assert (content["targets"], content["annotations_not_counted"]) == (3, 2)
    assert (content["estimates_counted"], content["estimates_not_counted"]) == (4, 0)
    json.dumps(content)
    assert scores.table().splitlines()[-1].split() == ["all", "3", *[f"{50 * expected:.1f}"] * 3]


def test_a_second_estimate_of_an_instance_is_wrong(shifts):
    """Right 0.9 and its double 0.5; of two to find one: precision 1 up to recall 1/2."""
    double = [estimate(0, 1, 0.9, at(0.0)), estimate(0, 1, 0.5, at(0.0))]
    assert score_pose_detections(shifts, double).average("mssd", 1) == pytest.approx(51 / 101)
    # The double first: 1/2 there, as it takes the instance; the better estimate is the wrong one then.
    double = [estimate(0, 1, 0.9, at(3.0)), estimate(0, 1, 0.95, at(4.0)), estimate(1, 1, 0.5, at(-100.0))]
    assert score_pose_detections(shifts, double).average("mssd", 1) == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_ties_keep_the_order_of_images_and_lines(shifts):
    right, wrong = estimate(0, 1, 0.5, at(0.0)), estimate(0, 1, 0.5, at(-300.0))
    later = estimate(1, 1, 0.5, at(-300.0))
    first, second = 51 / 101, 51 / 2 / 101
    for results, expected in (
        ([right, wrong], first),
        ([wrong, right], second),
        ([later, right], first),  # images in their order, whatever that of the file
    ):
        assert score_pose_detections(shifts, results).average("mspd", 1) == pytest.approx(expected)


def test_nothing_found_nothing_to_find_wrong_object(shifts):
    empty = score_pose_detections(shifts, [])
    assert (empty.overall(), empty.average("mssd", 2)) == (0.0, 0.0)
    nothing = score_pose_detections(shifts, FOUND, object_ids=[3])
    assert (nothing.overall(), nothing.targets, nothing.to_json()["AP"]) == (None, {}, None)
    # Object 2 is not annotated in image 0: not counted, as in the toolkit. In image 1 it is, elsewhere: wrong.
    lone = [estimate(1, 2, 0.5, at(100.0))]
    elsewhere = estimate(0, 2, 0.9, at(0.0))
    assert score_pose_detections(shifts, [*lone, elsewhere]).average("mssd", 2) == 1.0
    assert score_pose_detections(shifts, [*lone, elsewhere]).facts["estimates_not_counted"] == 1
    mistaken = estimate(1, 2, 0.9, at(-100.0))  # where object 1 is
    assert score_pose_detections(shifts, [*lone, mistaken]).average("mssd", 2) == 0.5
    assert score_pose_detections(shifts, lone, images=[(1, 0)]).targets == {1: 1}


def test_the_hundred_best_of_an_image_count(shifts):
    many = [estimate(1, 1, 0.9 - 1e-4 * i, at(300.0)) for i in range(99)]
    right = estimate(1, 2, 0.5, at(100.0))
    assert score_pose_detections(shifts, [right, *many]).average("mssd", 2) == 1.0
    one_more = score_pose_detections(shifts, [right, *many, many[0]])
    assert one_more.average("mssd", 2) == 0.0
    assert one_more.facts["estimates_not_counted"] == 1


def test_equals_a_plain_loop(tmp_path):
    """Random boxes, symmetries, doubles and ties against the toolkit's rules, one estimate after the other."""
    root = make_scored_dataset(tmp_path / "boxes", np.random.default_rng(4), with_depth=False)
    dataset = BopDataset(root, targets="test_targets_bop24.json")
    results = random_results(dataset, np.random.default_rng(5))
    scores = score_pose_detections(dataset, results)
    errors = {
        (id(result), annotation.index): plain_errors(dataset, result, annotation)
        for result in results
        if (result.scene_id, result.im_id) in dataset.images()
        for annotation in dataset.annotations(result.scene_id, result.im_id)
        if annotation.obj_id == result.obj_id
    }
    for name in ("mssd", "mspd"):
        for obj_id in (1, 3):
            step = 0.05 if name == "mssd" else 5.0
            expected = [
                plain_precision(
                    dataset, results, obj_id, {k: e[name] for k, e in errors.items()}, step + step * k
                )
                for k in range(10)
            ]
            assert scores.precisions[name][obj_id].tolist() == pytest.approx(expected, abs=1e-12)
            assert 0.05 < np.mean(expected) < 0.95


def plain_precision(dataset, results, obj_id, errors, threshold):
    rows, count = [], 0
    for image in dataset.images():
        truths = [a for a in dataset.annotations(*image) if a.obj_id == obj_id]
        count += sum(a.visible_fraction >= 0.1 for a in truths)
        mine = [r for r in results if (r.scene_id, r.im_id, r.obj_id) == (*image, obj_id)]
        for result in sorted(mine, key=lambda r: -r.score) if truths else []:
            nearest = min(truths, key=lambda a: errors[id(result), a.index], default=None)
            if nearest is None or errors[id(result), nearest.index] >= threshold:
                rows.append((result.score, False))
                continue
            if nearest.visible_fraction >= 0.1:
                rows.append((result.score, True))
            truths = [a for a in truths if a is not nearest]
    right, points = 0, []
    for total, (_, correct) in enumerate(sorted(rows, key=lambda row: -row[0]), start=1):
        right += correct
        points.append((right / count, right / total))
    wanted = np.linspace(0.0, 1.0, 101)
    return float(np.mean([max([p for r, p in points if r >= w], default=0.0) for w in wanted]))


def test_what_is_missing_is_named(shifts, tmp_path):
    root = shutil.copytree(shifts.root, tmp_path / "copy")
    (root / "test/000001/scene_gt_info.json").unlink()
    with pytest.raises(BopError, match="visible fraction of object 1 in image 0 of scene 1 is not known"):
        score_pose_detections(BopDataset(root, targets="test_targets_bop24.json"), [])
    (root / "test/000001/scene_gt.json").unlink()
    with pytest.raises(BopError, match=r"scene 1 .* has no ground truth"):
        score_pose_detections(BopDataset(root, targets="test_targets_bop24.json"), [])

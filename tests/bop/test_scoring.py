import json
import math
import shutil

import numpy as np
import pytest
import torch

from foundpose.bop.dataset import BopDataset
from foundpose.bop.files import BopError
from foundpose.bop.localization import localization
from foundpose.bop.results import PoseResult, read_results
from foundpose.bop.scoring import score_results, vsd_errors
from tests.bop.scored_dataset import HALF_TURN, make_scored_dataset, plain_recalls, random_results


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    return BopDataset(
        make_scored_dataset(tmp_path_factory.mktemp("scored") / "boxes", np.random.default_rng(4))
    )


@pytest.fixture(scope="module")
def results(boxes):
    return random_results(boxes, np.random.default_rng(5))


def truth_results(dataset, score=1.0):
    """The annotations themselves as estimates."""
    return [
        PoseResult(*image, a.obj_id, score, a.T_camera_from_model, 1.0)
        for image in dataset.images()
        for a in dataset.annotations(*image)
    ]


def test_equals_a_plain_loop(boxes, results):
    scores = score_results(boxes, results).to_json()
    expected = plain_recalls(boxes, results)
    asked = {obj_id: sum(t.inst_count for t in boxes.targets() if t.obj_id == obj_id) for obj_id in (1, 3)}
    assert scores["targets"] == sum(asked.values())
    for name in ("mssd", "mspd", "vsd"):
        part = scores[name]
        for obj_id in (1, 3):
            found = torch.tensor(part["objects"][str(obj_id)]["found"])
            for key in np.ndindex(tuple(found.shape)):
                assert found[key] == expected[name][obj_id, *key], (name, obj_id, key)
            assert part["objects"][str(obj_id)]["targets"] == asked[obj_id]
            average = float(found.double().mean()) / asked[obj_id]
            assert part["objects"][str(obj_id)]["AR"] == pytest.approx(average, abs=1e-12)
        total = sum(torch.tensor(part["objects"][k]["found"]) for k in ("1", "3"))
        assert part["found"] == total.tolist()
        assert part["recalls"] == (total.double() / scores["targets"]).tolist()
        # Neither empty nor full, so the comparison says something.
        assert 0.1 < part["AR"] < 0.9
    assert scores["AR"] == pytest.approx(
        sum(scores[f"AR_{n}"] for n in ("MSSD", "MSPD", "VSD")) / 3, abs=1e-12
    )
    assert "AR_missing" not in scores


def test_facts_count_what_was_used(boxes, results):
    scores = score_results(boxes, results, errors=("mssd",)).to_json()
    keys = [(r.scene_id, r.im_id, r.obj_id) for r in results]
    targets = boxes.targets()
    used = [min(keys.count(t[:3]), t.inst_count) for t in targets]
    assert (scores["dataset"], scores["split"]) == ("boxes", "test")
    assert scores["targets_file"] == "test_targets_bop19.json"
    assert scores["images"] == 8
    assert scores["estimates_in_file"] == len(results)
    assert scores["estimates_outside_targets"] == 2
    assert scores["estimates_used"] == sum(used) < len(results) - 2
    assert scores["target_instances_without_estimate"] == sum(t.inst_count for t in targets) - sum(used) > 0
    assert scores["target_instances_without_annotation"] == 0
    timed = {r.im_id: r.time for r in results if r.scene_id == 5 and r.obj_id != 77}
    assert scores["average_time_per_image"] == pytest.approx(sum(timed.values()) / len(timed))
    unknown = [*results[:-1], PoseResult(5, 1, 1, 0.1, torch.eye(4, dtype=torch.float64), -1.0)]
    one_unknown = [
        PoseResult(r.scene_id, r.im_id, r.obj_id, r.score, r.T_camera_from_model, -1.0) for r in unknown
    ]
    assert score_results(boxes, one_unknown, errors=("mssd",)).to_json()["average_time_per_image"] is None


def test_truth_scores_one_and_nothing_scores_zero(boxes):
    everything = truth_results(boxes)
    targets = {t[:3]: t.inst_count for t in boxes.targets()}
    wanted = []
    for image in boxes.images():
        for obj_id in (1, 3):
            annotations = [a for a in boxes.annotations(*image) if a.obj_id == obj_id]
            annotations.sort(key=lambda a: -a.visible_fraction)
            for a in annotations[: targets[*image, obj_id]]:
                wanted.append(PoseResult(*image, obj_id, 1.0, a.T_camera_from_model, 1.0))
    assert len(wanted) < len(everything)
    perfect = score_results(boxes, wanted, errors=("mssd", "mspd", "vsd", "add_s")).to_json()
    assert perfect["AR_MSSD"] == perfect["AR_MSPD"] == 1.0
    assert perfect["add_s"]["recalls"] == [1.0, 1.0, 1.0]
    assert perfect["AR_VSD"] > 0.9  # but for instances that nothing is seen of
    # All scores are equal, so with all annotations as estimates some of the wanted ones are not counted.
    rest = score_results(boxes, everything, errors=("mssd",)).to_json()
    assert rest["estimates_used"] == rest["targets"] == perfect["targets"]
    assert 0.5 < rest["AR_MSSD"] < 1.0
    nothing = score_results(boxes, [])
    content = nothing.to_json()
    assert content["AR"] == content["AR_VSD"] == 0.0
    assert content["estimates_used"] == 0
    assert content["target_instances_without_estimate"] == content["targets"] > 0
    assert content["average_time_per_image"] is None
    json.dumps(content, allow_nan=False)


def one_target(tmp_path, boxes, inst_count):
    """Copy of the dataset with one target: object 1 in image 0, whose annotations are two."""
    root = shutil.copytree(boxes.root, tmp_path / "one")
    (root / "test_targets_bop19.json").write_text(
        json.dumps([{"scene_id": 5, "im_id": 0, "obj_id": 1, "inst_count": inst_count}])
    )
    truth = json.loads((root / "test/000005/scene_gt.json").read_text())
    poses = [[1.0, 0, 0, 0, 1, 0, 0, 0, 1], [1.0, 0, 0, 0, 0, -1, 0, 1, 0]]
    truth["0"] = [
        {"obj_id": 1, "cam_R_m2c": R, "cam_t_m2c": [60.0 * k, 0.0, 600.0]} for k, R in enumerate(poses)
    ]
    (root / "test/000005/scene_gt.json").write_text(json.dumps(truth))
    info = json.loads((root / "test/000005/scene_gt_info.json").read_text())
    info["0"] = [{"visib_fract": 0.4}, {"visib_fract": 0.7}]
    (root / "test/000005/scene_gt_info.json").write_text(json.dumps(info))
    dataset = BopDataset(root)
    return dataset, [a.T_camera_from_model for a in dataset.annotations(5, 0)]


def found_at_all(dataset, estimates):
    """Instances found at every threshold of MSSD and MSPD, which must be the same number."""
    results = [PoseResult(5, 0, 1, score, T, 0.0) for score, T in estimates]
    content = score_results(dataset, results, errors=("mssd", "mspd")).to_json()
    counts = set(content["mssd"]["found"] + content["mspd"]["found"])
    assert len(counts) == 1
    return counts.pop(), content


def test_equal_scores_take_the_order_of_the_file(tmp_path, boxes):
    dataset, (less, more) = one_target(tmp_path, boxes, 1)
    away = less.clone()
    away[0, 3] += 1000.0
    assert found_at_all(dataset, [(0.5, more), (0.5, away)])[0] == 1
    assert found_at_all(dataset, [(0.5, away), (0.5, more)])[0] == 0
    assert found_at_all(dataset, [(0.5, away), (0.6, more)])[0] == 1
    # Only the most visible annotation is to be found.
    assert found_at_all(dataset, [(0.5, less)])[0] == 0


def test_symmetric_object_and_several_instances(tmp_path, boxes):
    dataset, (less, more) = one_target(tmp_path, boxes, 2)
    turned = more @ torch.from_numpy(HALF_TURN)
    assert found_at_all(dataset, [(0.5, turned), (0.1, less)])[0] == 2
    assert found_at_all(dataset, [(0.5, turned), (0.1, more)])[0] == 1  # both are the same instance
    count, content = found_at_all(dataset, [(0.5, turned)])
    assert count == 1
    assert content["target_instances_without_estimate"] == 1
    quarter = more.clone()
    quarter[:3, 0], quarter[:3, 1] = more[:3, 1], -more[:3, 0]
    quarter_turned = [PoseResult(5, 0, 1, 0.9, quarter, 0.0)]
    assert score_results(dataset, quarter_turned, errors=("mssd",)).to_json()["mssd"]["found"][0] == 0
    broken = more.clone()
    broken[0, 3] = math.nan
    assert found_at_all(dataset, [(0.9, broken), (0.8, less)])[0] == 1
    assert score_results(dataset, [PoseResult(5, 0, 1, 1.0, broken, 0.0)]).to_json()["AR"] == 0.0


def test_target_that_asks_for_more_than_is_annotated(tmp_path, boxes):
    dataset, (less, more) = one_target(tmp_path, boxes, 5)
    count, content = found_at_all(dataset, [(1.0, less), (1.0, more), (1.0, more)])
    assert (count, content["targets"]) == (2, 2)
    assert content["target_instances_without_annotation"] == 3
    assert content["AR_MSSD"] == 1.0


def test_unknown_visibility_counts_as_fully_visible(tmp_path, boxes):
    dataset, (first, second) = one_target(tmp_path, boxes, 1)
    path = dataset.root / "test/000005/scene_gt_info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {"0": [{"visib_fract": 0.4}, {}]}))
    assert found_at_all(BopDataset(dataset.root), [(1.0, second)])[0] == 1
    path.unlink()  # all unknown: the first annotation
    assert found_at_all(BopDataset(dataset.root), [(1.0, second)])[0] == 0
    assert found_at_all(BopDataset(dataset.root), [(1.0, first)])[0] == 1


def test_delta_and_progress(boxes, results):
    steps = []
    exact = BopDataset(boxes.root, vsd_delta=1.0)
    strict = score_results(
        exact, results, errors=("vsd", "mssd"), progress=lambda *step: steps.append(step)
    ).to_json()
    assert strict["vsd_delta"] == 1.0
    assert strict["vsd"]["found"] != score_results(boxes, results, errors=("vsd",)).to_json()["vsd"]["found"]
    assert [s for s in steps if s[0] == "VSD"] == [("VSD", k, 8) for k in range(1, 9)]
    assert steps[1][0] == "pose errors"
    assert steps[1][1] == steps[1][2]
    assert strict["mspd"] == {"computed": False, "reason": "not asked for"}
    assert strict["AR_missing"] == "AR needs AR_MSPD (not asked for)"


def test_results_in_steps_are_the_same(boxes, results, monkeypatch):
    whole = score_results(boxes, results, errors=("mssd", "mspd", "vsd", "add_s")).to_json()
    monkeypatch.setattr("foundpose.bop.scoring._PAIRS_PER_STEP", 3)
    monkeypatch.setattr("foundpose.bop.scoring._TARGETS_PER_STEP", 2)
    assert score_results(boxes, results, errors=("mssd", "mspd", "vsd", "add_s")).to_json() == whole


@pytest.mark.gpu
def test_cuda_gives_the_same(boxes, results):
    names = ("mssd", "mspd", "vsd", "add_s")
    on_cpu, on_gpu = (score_results(boxes, results, names, device=d).to_json() for d in ("cpu", "cuda"))
    assert on_gpu == on_cpu


def test_missing_depth_is_said(tmp_path, boxes, results):
    root = shutil.copytree(boxes.root, tmp_path / "shallow")
    (root / "test/000005/depth/000003.png").unlink()
    scores = score_results(BopDataset(root), results)
    content = scores.to_json()
    reason = "no depth image for 1 of 8 images with targets"
    assert content["vsd"] == {"computed": False, "reason": reason}
    assert content["AR"] is None
    assert content["AR_VSD"] is None
    assert content["AR_missing"] == f"AR needs AR_VSD ({reason})"
    assert content["AR_MSSD"] == score_results(boxes, results).to_json()["AR_MSSD"]
    assert content["objects"]["1"]["AR"] is None
    json.dumps(content, allow_nan=False)
    rows = scores.table().splitlines()
    assert rows[0].split() == ["object", "targets", "AR_MSSD", "AR_MSPD", "AR_VSD", "AR"]
    assert rows[1].split()[0] == "1"
    assert rows[-1].split()[:2] == ["all", str(content["targets"])]
    assert rows[-1].split()[2:] == [
        f"{100 * content['AR_MSSD']:.1f}",
        f"{100 * content['AR_MSPD']:.1f}",
        "–",
        "–",
    ]
    assert len({len(row) for row in rows}) == 1


def test_table_with_everything(boxes, results):
    scores = score_results(boxes, results, errors=("mssd", "mspd", "vsd", "add_s"))
    content, rows = scores.to_json(), scores.table().splitlines()
    assert len(rows) == 5
    row = rows[2].split()
    assert row[0] == "3"
    numbers = [content["objects"]["3"][f"AR_{n}"] for n in ("MSSD", "MSPD", "VSD")]
    numbers += [content["objects"]["3"]["AR"], content["add_s"]["objects"]["3"]["recalls"][2]]
    assert row[2:] == [f"{100 * n:.1f}" for n in numbers]
    assert numbers[3] == pytest.approx(sum(numbers[:3]) / 3)
    assert content["add_s"]["thresholds"] == [0.02, 0.05, 0.1]


def test_targets_of_images_alone(boxes, results):
    dataset = BopDataset(boxes.root, targets="test_targets_bop24.json")
    content = score_results(dataset, results, errors=("mssd", "mspd")).to_json()
    visible = [a for im in boxes.images() for a in boxes.annotations(*im) if a.visible_fraction >= 0.1]
    assert content["targets"] == len(visible)
    assert content["task"].startswith("localization recall on targets derived from the ground truth")
    assert score_results(boxes, results, errors=("mssd",)).to_json()["task"].startswith("6D localization")


def test_what_is_missing_is_named(tmp_path, boxes, results):
    with pytest.raises(ValueError, match=r"errors must be some of mssd, .* got \['msd'\]"):
        score_results(boxes, results, errors=("msd",))
    root = shutil.copytree(boxes.root, tmp_path / "blind")
    (root / "test/000005/scene_gt.json").unlink()
    for targets in ("test_targets_bop19.json", "test_targets_bop24.json"):
        with pytest.raises(BopError, match=r"scene 5 .* has no ground truth"):
            score_results(BopDataset(root, targets=targets), results)
    shutil.rmtree(root / "models_eval")
    with pytest.raises(BopError, match="models_eval holds no models_info"):
        score_results(BopDataset(root), results)


def reference(lmo_root, name):
    path = lmo_root.parent / "bop_reference" / name
    if not path.is_file():
        pytest.skip(f"no reference numbers at {path}")
    return path


def test_equals_the_toolkit_on_lmo(lmo_root):
    expected = json.loads(reference(lmo_root, "scores.json").read_text())
    results = read_results(reference(lmo_root, "megapose_lmo50.csv"))
    content = score_results(BopDataset(lmo_root), results).to_json()
    for name in ("mssd", "mspd"):
        for field in ("thresholds", "found", "recalls"):
            assert content[name][field] == expected[name][field]
        assert content[f"AR_{name.upper()}"] == pytest.approx(expected[f"AR_{name.upper()}"], abs=1e-12)
        averages = {obj_id: entry["AR"] for obj_id, entry in content[name]["objects"].items()}
        assert averages == pytest.approx(expected[name]["AR_per_object"], abs=1e-12)
    facts = ("targets", "images", "estimates_in_file", "estimates_used", "target_instances_without_estimate")
    for field in (*facts, "estimates_outside_targets"):
        assert content[field] == expected[field]
    assert content["vsd"]["reason"] == "no depth image for 50 of 50 images with targets"


def test_equals_the_toolkit_on_an_image_of_lmo_with_depth(lmo_root, tmp_path):
    expected = json.loads(reference(lmo_root, "vsd/megapose_image3.json").read_text())
    results = read_results(reference(lmo_root, "megapose_lmo50.csv"))
    scene = tmp_path / "lmo" / "test" / "000002"
    for folder in ("rgb", "depth"):
        (scene / folder).mkdir(parents=True)
    for name in ("models", "models_eval"):
        (tmp_path / "lmo" / name).symlink_to(lmo_root / name)
    for path in (lmo_root / "test/000002").glob("scene_*.json"):
        (scene / path.name).symlink_to(path)
    (scene / "rgb/000003.png").symlink_to(lmo_root / "test/000002/rgb/000003.png")
    (scene / "depth/000003.png").symlink_to(reference(lmo_root, "vsd/depth_000003.png"))
    targets = json.loads((lmo_root / "test_targets_bop19.json").read_text())
    (tmp_path / "lmo/test_targets_bop19.json").write_text(json.dumps([t for t in targets if t["im_id"] == 3]))
    content = score_results(BopDataset(tmp_path / "lmo"), results).to_json()
    for name in ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD"):
        assert content[name] == pytest.approx(expected[name], abs=1e-12)
    assert content["targets"] == expected["targets"]
    assert content["estimates_used"] == expected["estimates_used"]
    assert content["estimates_outside_targets"] == sum(result.im_id != 3 for result in results)
    assert content["vsd"]["taus"] == expected["taus"]
    assert content["vsd"]["thresholds"] == expected["vsd_thresholds"]
    assert content["vsd"]["recalls"] == expected["vsd_recalls_row_per_tau"]
    assert content["mssd"]["recalls"] == expected["mssd_recalls"]
    assert content["mspd"]["recalls"] == expected["mspd_recalls"]
    tables = localization(BopDataset(tmp_path / "lmo"), results)
    errors = vsd_errors(BopDataset(tmp_path / "lmo"), tables)
    for row in expected["rows"]:
        (target,) = (tables.estimates[:, 0] == row["row"]).nonzero().flatten().tolist()
        assert tables.object_ids[tables.object[target]] == row["obj_id"]
        assert errors[target, :, 0, 0].tolist() == pytest.approx(row["vsd"], abs=0.003)


def test_a_part_of_the_targets(boxes, results):
    targets = boxes.targets()[:2]
    part = score_results(boxes, results, errors=("mssd",), targets=targets).to_json()
    whole = score_results(boxes, results, errors=("mssd",)).to_json()
    assert part["targets"] == sum(target.inst_count for target in targets) < whole["targets"]
    assert part["estimates_in_file"] == len(results)
    assert part["estimates_outside_targets"] > whole["estimates_outside_targets"]
    with pytest.raises(BopError, match="nothing to localise"):
        score_results(boxes, results, targets=[])

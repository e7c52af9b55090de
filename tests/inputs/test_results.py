"""Results files and ground truth that are wrong in ways that used to be scored: rotations and units."""

import json
import shutil

import numpy as np
import pytest
import torch

from foundpose.bop import BopDataset, BopError, PoseResult, read_results, score_results
from foundpose.evaluation.objects import DatasetObjects
from foundpose.geometry import se3_exp
from foundpose.utils.units import UnitError, check_unit
from tests.bop.scored_dataset import make_scored_dataset

R = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.3, -0.5, 0.2], dtype=torch.float64))[:3, :3].numpy()
SHEARED = R @ np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

ACCEPTED = {
    "rotation": R,
    "BOP's own scale": R * 1.005,
    "rounded": R.round(3),
    "single precision": R.astype(np.float32),
}
REFUSED = {
    "reflection": (R @ np.diag([1.0, 1.0, -1.0]), "it is a reflection scaled by 1;"),
    "half turn and reflection": (-R, "it is a reflection scaled by 1;"),
    "in millimetres": (R * 1000.0, "it is a rotation scaled by 1000;"),
    "scaled": (R * 1.05, r"it is a rotation scaled by 1\.05;"),
    "zero": (R * 0.0, "it is a rotation scaled by 0;"),
    "sheared": (SHEARED, r"axes are not orthogonal \(singular values \[1\.0512, 1\.0, 0\.9512\]\)"),
    "stretched": (R * np.array([1.0, 1.0, 1.2]), "axes are not orthogonal"),
    "angles": (np.array([[0.1, 0.2, 0.3]] * 3), "axes are not orthogonal"),
    "quaternion, padded": (np.array([[0.9, 0.1, 0.2], [0.3, 0, 0], [0, 0, 0]]), "axes are not orthogonal"),
}


def line(rotation):
    return f"1,2,3,0.5,{' '.join(map(str, np.asarray(rotation).ravel().tolist()))},10 20 800,0.1"


def write(path, rotation):
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{line(R)}\n{line(rotation)}\n")


@pytest.mark.parametrize("name", ACCEPTED)
def test_rotations_of_results(tmp_path, name):
    write(tmp_path / "r.csv", ACCEPTED[name])
    got = read_results(tmp_path / "r.csv")[1].T_camera_from_model[:3, :3]
    assert torch.equal(got, torch.from_numpy(ACCEPTED[name].astype(np.float64)))


@pytest.mark.parametrize("name", REFUSED)
def test_lines_without_a_rotation(tmp_path, name):
    rotation, message = REFUSED[name]
    write(tmp_path / "r.csv", rotation)
    with pytest.raises(
        BopError, match=rf"r\.csv, line 3: not a BOP result \(R must be a rotation.* {message}"
    ):
        read_results(tmp_path / "r.csv")


@pytest.mark.parametrize("name", REFUSED)
def test_annotations_without_a_rotation(tiny_bop, tmp_path, name):
    rotation, message = REFUSED[name]
    root = shutil.copytree(tiny_bop, tmp_path / "tiny")
    path = root / "test" / "000001" / "scene_gt.json"
    truth = json.loads(path.read_text())
    truth["0"][0]["cam_R_m2c"] = rotation.ravel().tolist()
    path.write_text(json.dumps(truth))
    with pytest.raises(BopError, match=rf"image 0, annotation 0: cam_R_m2c must be a rotation.* {message}"):
        BopDataset(root).annotations(1, 0)


@pytest.fixture
def boxes(tmp_path):
    return make_scored_dataset(tmp_path / "boxes", np.random.default_rng(4), images=2)


def truths(root, scale=1.0):
    dataset = BopDataset(root)
    results = []
    for image in dataset.images():
        for a in dataset.annotations(*image):
            T = a.T_camera_from_model.clone()
            T[:3, 3] *= scale
            results.append(PoseResult(*image, a.obj_id, 1.0, T, 0.1))
    return results


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_units_that_agree(boxes):
    assert (
        score_results(BopDataset(boxes), truths(boxes)).overall() > 0.8
    )  # some annotations are not asked for


def test_estimates_in_metres(boxes):
    with pytest.raises(
        UnitError, match=r"distance of the estimates is 0\.\d+ and that of the ground truth is \d+"
    ):
        score_results(BopDataset(boxes), truths(boxes, 0.001))


def test_ground_truth_in_metres(boxes):
    def change(content):
        for entries in content.values():
            for entry in entries:
                entry["cam_t_m2c"] = [x / 1000 for x in entry["cam_t_m2c"]]

    edit(boxes / "test/000005/scene_gt.json", change)
    with pytest.raises(
        UnitError, match=r"distance in .*test is 0\.\d+ and ten times the diameter .* Metres beside"
    ):
        score_results(BopDataset(boxes), truths(boxes))


def test_models_in_metres(boxes):
    results = truths(boxes)

    def change(content):
        for entry in content.values():
            entry["diameter"] /= 1000

    edit(boxes / "models_eval/models_info.json", change)
    with pytest.raises(UnitError, match=r"a factor of .* are they in the same unit"):
        score_results(BopDataset(boxes), results)


def test_a_mesh_and_its_entry(boxes, tmp_path):
    def change(content):
        content["1"]["diameter"] /= 1000

    edit(boxes / "models/models_info.json", change)

    class Store:
        folder = tmp_path

    with pytest.raises(
        UnitError, match=r"of .*obj_000001\.ply is 1\d\d.* and that in models_info\.json is 0"
    ):
        DatasetObjects(BopDataset(boxes), Store()).mesh(1)


def test_depth_scale(boxes):
    def change(content):
        for entry in content.values():
            entry["depth_scale"] /= 1000

    edit(boxes / "test/000005/scene_camera.json", change)
    results = truths(boxes)
    assert score_results(BopDataset(boxes), results, errors=("mssd",)).average_recall("mssd") > 0.8
    with pytest.raises(UnitError, match="median depth of image 0 of scene 5 with its depth_scale is 0"):
        score_results(BopDataset(boxes), results)


@pytest.mark.parametrize("length", [0.0, 5.0, 10.0, 100.0, 1000.0])
def test_within_the_factor(length):
    check_unit(length, "a", 50.0, "b", 20.0)


@pytest.mark.parametrize(
    ("length", "factor"), [(0.05, "0.001"), (2.4, "0.048"), (1001.0, "20"), (50_000.0, "1e\\+03")]
)
def test_beyond_the_factor(length, factor):
    with pytest.raises(UnitError, match=f"a is .* and b is 50, a factor of {factor}.*millimetres throughout"):
        check_unit(length, "a", 50.0, "b", 20.0)

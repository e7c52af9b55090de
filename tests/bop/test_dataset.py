import json
import pickle
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.bop import (
    BopDataset,
    BopError,
    Target,
    detected_instances,
    ground_truth_instances,
)
from foundpose.geometry import symmetries_from_models_info
from foundpose.rendering import load_mesh
from tests.bop_dataset import DEPTH_SCALE


@pytest.fixture
def own_bop(tiny_bop, tmp_path):
    """A copy of the dataset, to be changed."""
    return shutil.copytree(tiny_bop, tmp_path / "own")


def edit(path, change):
    """Apply ``change`` to a JSON file."""
    content = json.loads(path.read_text())
    path.write_text(json.dumps(change(content) or content))


def test_reads_what_was_written(tiny_bop):
    dataset = BopDataset(tiny_bop)
    assert dataset.object_ids == [1, 2]
    assert [tuple(t) for t in dataset.targets()] == [(1, 0, 1, 1), (1, 1, 2, 1), (1, 2, 1, 1)]
    assert dataset.images() == [(1, 0), (1, 1), (1, 2)]
    assert dataset.localization_targets() == dataset.targets()
    truth = json.loads((tiny_bop / "test/000001/scene_gt.json").read_text())["1"][0]
    assert dataset.has_ground_truth(1)
    (annotation,) = dataset.annotations(1, 1)
    assert annotation.obj_id == 2
    assert annotation.T_camera_from_model[:3, :3].flatten().tolist() == truth["cam_R_m2c"]
    assert annotation.T_camera_from_model[:3, 3].tolist() == truth["cam_t_m2c"]
    assert annotation.T_camera_from_model[3].tolist() == [0, 0, 0, 1]
    assert annotation.visible_fraction == 0.88
    assert dataset.intrinsics(1, 0)[2].tolist() == [0, 0, 1]
    image = dataset.image(1, 0)
    assert image.shape == (3, 480, 640)
    assert dataset.image_size(1, 0) == (480, 640)
    reference = np.asarray(Image.open(tiny_bop / "test/000001/rgb/000000.png"))
    assert torch.equal((image * 255).round().byte().permute(1, 2, 0), torch.from_numpy(reference.copy()))
    mask = dataset.visible_mask(1, 0, 0)
    assert mask.dtype == torch.bool
    assert 1000 < mask.sum() < 480 * 640 / 3
    silhouette = dataset.mask(1, 0, 0)
    assert bool((silhouette | ~mask).all())
    assert mask.sum() < 0.95 * silhouette.sum()


def test_depth_is_millimetres(tiny_bop):
    dataset = BopDataset(tiny_bop)
    assert dataset.has_depth(1, 0)
    assert not dataset.has_depth(1, 99)
    depth = dataset.depth(1, 0)
    assert depth.shape == (480, 640)
    assert depth.dtype == torch.float32
    stored = np.asarray(Image.open(tiny_bop / "test/000001/depth/000000.png"))
    assert torch.equal(depth, torch.from_numpy(stored.astype(np.float32)) * DEPTH_SCALE)
    assert not depth[:, :20].any()
    # The visible part of the object is where its centre is, to its radius.
    seen = depth[dataset.visible_mask(1, 0, 0)]
    distance = float(dataset.annotations(1, 0)[0].T_camera_from_model[2, 3])
    assert 5 < (seen - distance).abs().max() < dataset.diameter(1)


def test_models_for_evaluation(own_bop):
    dataset = BopDataset(own_bop)
    assert dataset.has_evaluation_models()
    assert dataset.evaluation_mesh_path(2) == own_bop / "models_eval/obj_000002.ply"
    assert load_mesh(dataset.evaluation_mesh_path(2)).diameter == pytest.approx(dataset.diameter(2), rel=1e-6)
    assert symmetries_from_models_info(dataset.evaluation_info(1)).transforms.tolist() == [
        [torch.eye(4).tolist()]
    ]
    turn = [-1, 0, 0, 5, 0, -1, 0, 7, 0, 0, 1, 0, 0, 0, 0, 1]

    def add_symmetries(infos):
        infos["1"]["symmetries_discrete"] = [turn]
        infos["1"]["symmetries_continuous"] = [{"axis": [0, 0, 2], "offset": [1, 2, 3]}]
        infos["2"]["diameter"] = 0

    path = own_bop / "models_eval/models_info.json"
    edit(path, add_symmetries)
    symmetries = symmetries_from_models_info(dataset.evaluation_info(1))
    assert symmetries.transforms.dtype == torch.float64
    assert symmetries.transforms[0, 1].flatten().tolist() == turn
    assert symmetries.axes.tolist() == [[[0, 0, 1]]]
    assert symmetries.origins.tolist() == [[[1, 2, 3]]]
    assert dataset.evaluation_info(1)["diameter"] == dataset.diameter(1)
    with pytest.raises(BopError, match="diameter of object 2 must be a positive number, got 0"):
        dataset.evaluation_info(2)
    with pytest.raises(FileNotFoundError, match=r"has no object 3; it has \[1, 2\]"):
        dataset.evaluation_info(3)
    edit(path, lambda infos: infos["1"].update(symmetries_discrete=[[1, 2]]))
    with pytest.raises(
        BopError, match=r"models_info.json, object 1: symmetries_discrete\[0\] must be 16 finite numbers"
    ):
        dataset.evaluation_info(1)
    shutil.rmtree(own_bop / "models_eval")
    assert not dataset.has_evaluation_models()
    for ask in (dataset.evaluation_info, dataset.evaluation_mesh_path):
        with pytest.raises(
            FileNotFoundError, match=r"models_info.json is missing; the folder .*models_eval does not"
        ):
            ask(1)


def test_inference_never_looks_at_ground_truth(own_bop):
    scene = own_bop / "test/000001"
    everything = BopDataset(own_bop)
    expected = detected_instances(everything, own_bop / "detections/cnos-fastsam")
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (scene / name).unlink()
    for folder in (scene / "mask", scene / "mask_visib", scene / "depth", own_bop / "models_eval"):
        shutil.rmtree(folder)
    dataset = BopDataset(own_bop)
    assert dataset.targets() == everything.targets()
    assert dataset.images() == [(1, 0), (1, 1), (1, 2)]
    instances = detected_instances(dataset, own_bop / "detections/cnos-fastsam")
    assert instances == expected
    for instance in instances:
        key = (instance.scene_id, instance.im_id)
        assert instance.mask(dataset).shape == dataset.image(*key).shape[1:] == dataset.image_size(*key)
        assert dataset.intrinsics(*key).shape == (3, 3)
        assert load_mesh(dataset.mesh_path(instance.obj_id)).diameter > 0
        assert dataset.diameter(instance.obj_id) > 0
    assert not dataset.has_ground_truth(1)
    assert not dataset.has_depth(1, 0)
    with pytest.raises(
        FileNotFoundError, match=r"scene_gt\.json is missing; .*000001 holds rgb/, scene_camera"
    ):
        dataset.annotations(1, 0)
    with pytest.raises(FileNotFoundError, match=r"no depth image 0 in .* \(looked for depth/; png and tif\)"):
        dataset.depth(1, 0)
    with pytest.raises(FileNotFoundError, match=r"no image at .*mask_visib"):
        dataset.visible_mask(1, 0, 0)


def test_bop24_targets_name_images(own_bop):
    (own_bop / "test_targets_bop24.json").write_text(
        '[{"scene_id": 1, "im_id": 2}, {"scene_id": 1, "im_id": 0}]'
    )
    gt, info = own_bop / "test/000001/scene_gt.json", own_bop / "test/000001/scene_gt_info.json"
    # Image 2 gets two more of object 2, one just visible enough, and one of object 1 that is not.
    edit(gt, lambda all: all["2"].extend([{**all["1"][0]}, {**all["1"][0]}, {**all["0"][0]}]))
    edit(
        info,
        lambda all: all["2"].extend([{"visib_fract": 0.1}, {"visib_fract": 0.9}, {"visib_fract": 0.0999}]),
    )
    dataset = BopDataset(own_bop, targets="test_targets_bop24.json")
    assert dataset.targets() == [Target(1, 2, None, None), Target(1, 0, None, None)]
    assert dataset.images() == [(1, 0), (1, 2)]
    wanted = [Target(1, 2, 1, 1), Target(1, 2, 2, 2), Target(1, 0, 1, 1)]
    assert dataset.localization_targets() == wanted
    assert dataset.localization_targets([Target(1, 0, None, None), Target(1, 1, 2, 1)]) == [
        Target(1, 0, 1, 1),
        Target(1, 1, 2, 1),
    ]
    instances = ground_truth_instances(dataset)
    assert [(i.im_id, i.obj_id, i.annotation_index) for i in instances] == [
        (2, 1, 0),
        (2, 2, 2),
        (2, 2, 1),
        (0, 1, 0),
    ]
    info.unlink()
    with pytest.raises(BopError, match=r"object 1 in image 2 of scene 1 is not known: scene_gt_info.json"):
        dataset.localization_targets()


def entry(scene_id=1, im_id=0, **more):
    return {"scene_id": scene_id, "im_id": im_id, **more}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([{"scene_id": 1}], "entry 0 lacks scene_id"),
        ([entry(), entry(im_id="1")], "entry 1 lacks"),
        ([entry(obj_id=1)], "entry 0 lacks"),
        ([entry(obj_id=1, inst_count=0)], "entry 0 lacks"),
        ([entry(obj_id=True, inst_count=1)], "entry 0 lacks"),
        ([3], "entry 0 lacks"),
        ({"1": 2}, "must hold a list of targets, it holds dict"),
        ([entry(), entry(obj_id=1, inst_count=1)], r"mixes entries .*bop19.* and without \(bop24\)"),
        ([entry(), entry(im_id=1), entry()], "lists image 0 of scene 1 2 times"),
        ([entry(obj_id=1, inst_count=n) for n in (1, 2)], "lists object 1 in image 0 of scene 1 2 times"),
        (
            [entry(obj_id=9, inst_count=1)],
            r"lists object 9 in image 0 of scene 1; the dataset has .* \[1, 2\]",
        ),
        ([entry(im_id=7)], "lists image 7 of scene 1, which scene_camera.json does not have"),
        ([entry(4)], "lists image 0 of scene 4, which does not exist; .*test holds 000001/"),
    ],
)
def test_bad_targets(own_bop, entries, message):
    (own_bop / "test_targets_bop19.json").write_text(json.dumps(entries))
    with pytest.raises((BopError, FileNotFoundError), match=message):
        BopDataset(own_bop).targets()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("scene_camera", {"cam_K": [1, 2, 3]}, "cam_K must be 9 numbers"),
        (
            "scene_camera",
            {"cam_K": [500, 0, 0, 0, 500, 0, 320, 240, 1]},
            "cam_K must be .* row by row, with focal lengths above 0",
        ),
        (
            "scene_camera",
            {"cam_K": [500, 0, 320, 0, -500, 240, 0, 0, 1]},
            "cam_K must be .* focal lengths above 0",
        ),
        ("scene_camera", {"cam_K": [float("nan"), 0, 320, 0, 500, 240, 0, 0, 1]}, "cam_K must be finite"),
        ("scene_camera", {"cam_K": None}, "cam_K must be 9 numbers, got None"),
        ("scene_camera", {"depth_scale": 0}, "depth_scale must be positive, got 0.0"),
        (
            "scene_gt",
            {"cam_R_m2c": [1.03, 0, 0, 0, 1.03, 0, 0, 0, 1.03]},
            "cam_R_m2c must be a rotation",
        ),
        ("scene_gt", {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, -1]}, "cam_R_m2c must be a rotation"),
        (
            "scene_gt",
            {"cam_R_m2c": [1, 0.1, 0, 0, 1, 0, 0, 0, 1]},
            r"cam_R_m2c must be .*its scale may be off by 2%",
        ),
        ("scene_gt", {"cam_t_m2c": [1, 2, float("inf")]}, "cam_t_m2c must be finite"),
        ("scene_gt", {"obj_id": "1"}, "obj_id must be a whole number, got '1'"),
        ("scene_gt_info", {"visib_fract": 1.5}, "visib_fract must be within 0 and 1, got 1.5"),
    ],
)
def test_bad_numbers(own_bop, name, change, message):
    def apply(content):
        (content["0"] if name == "scene_camera" else content["0"][0]).update(change)

    edit(own_bop / f"test/000001/{name}.json", apply)
    dataset = BopDataset(own_bop)
    ask = {"cam_K": dataset.intrinsics, "depth_scale": dataset.depth}.get(*change, dataset.annotations)
    with pytest.raises(BopError, match=rf"scene_(camera|gt).json, image 0.*: {message}"):
        ask(1, 0)
    assert len(dataset.annotations(1, 1)) == 1


def test_rotations_are_accepted_as_published(own_bop):
    R = [1.005, 0, 0, 0, 0, -1.004, 0, 1.005, 0]
    edit(own_bop / "test/000001/scene_gt.json", lambda all: all["0"][0].update(cam_R_m2c=R))
    assert BopDataset(own_bop).annotations(1, 0)[0].T_camera_from_model[:3, :3].flatten().tolist() == R
    edit(own_bop / "test/000001/scene_gt_info.json", lambda all: all["0"].append({"visib_fract": 1}))
    with pytest.raises(BopError, match=r"image 0: 1 annotations, but scene_gt_info.json has 2"):
        BopDataset(own_bop).annotations(1, 0)


def test_errors_say_what_was_looked_for_and_what_is_there(tiny_bop, own_bop, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no such folder. .*BOP_PATH.* that holds models/ and test/$"
    ):
        BopDataset(tmp_path / "nowhere")
    with pytest.raises(
        FileNotFoundError, match=rf"no such folder.* There is one at {tiny_bop}: is that the root"
    ):
        BopDataset(tiny_bop / "tiny")
    for inside in ("test", "test/000001", "models"):
        with pytest.raises(
            FileNotFoundError, match=rf"models/ is missing; .* There is one at {tiny_bop}: is that"
        ):
            BopDataset(tiny_bop / inside)
    with pytest.raises(
        FileNotFoundError, match=rf"models/ is missing; .* There is one at {own_bop}: is that"
    ):
        BopDataset(own_bop.parent)
    with pytest.raises(
        FileNotFoundError, match=r"val/ is missing; .*models/.* Folders with scenes: test \(data.split"
    ):
        BopDataset(tiny_bop, split="val")
    with pytest.raises(FileNotFoundError, match=r"scene 7 is missing; .* holds 000001/"):
        BopDataset(tiny_bop).image(7, 0)
    with pytest.raises(
        FileNotFoundError, match=r"no image 99 in .*; .* holds depth/, mask/, mask_visib/, rgb/"
    ):
        BopDataset(tiny_bop).image(1, 99)
    with pytest.raises(BopError, match=r"scene_camera.json has no entry for image 99"):
        BopDataset(tiny_bop).intrinsics(1, 99)
    with pytest.raises(FileNotFoundError, match=r"object 9 has no mesh .* has \[1, 2\]"):
        BopDataset(tiny_bop).mesh_path(9)
    (own_bop / "test/000001/scene_camera.json").write_text('{"0": {},\n "1": [}')
    with pytest.raises(BopError, match=r"scene_camera\.json is not valid JSON: .* line 2 column 8"):
        BopDataset(own_bop).intrinsics(1, 0)
    (own_bop / "models/models_info.json").write_text("[1]")
    with pytest.raises(BopError, match=r"models_info\.json must map object ids to entries"):
        BopDataset(own_bop)
    (own_bop / "models/models_info.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"models_info\.json is missing; .* holds obj_000001\.ply"):
        BopDataset(own_bop)


def test_a_changed_file_is_read_again_and_nothing_is_shipped(own_bop):
    dataset = BopDataset(own_bop)
    before = dataset.intrinsics(1, 0)
    fresh = len(pickle.dumps(BopDataset(own_bop)))
    dataset.annotations(1, 0)
    assert len(pickle.dumps(dataset)) == fresh
    edit(own_bop / "test/000001/scene_camera.json", lambda all: all["0"]["cam_K"].__setitem__(0, 777.0))
    assert dataset.intrinsics(1, 0)[0, 0] == 777 != before[0, 0]
    copy = pickle.loads(pickle.dumps(dataset))
    assert torch.equal(copy.intrinsics(1, 0), dataset.intrinsics(1, 0))


def test_reads_lmo(lmo_root):
    dataset = BopDataset(lmo_root)
    targets = dataset.targets()
    assert len(dataset.images()) == len({target[:2] for target in targets}) > 0
    # The published list was made from earlier visible fractions: about one target in thirty differs.
    visible = dataset.localization_targets([Target(*image, None, None) for image in dataset.images()])
    assert 0 < len(set(visible) ^ set(targets)) < 0.05 * len(targets)
    assert symmetries_from_models_info(dataset.evaluation_info(10)).transforms.shape == (1, 2, 4, 4)
    scales = [
        float(torch.linalg.det(a.T_camera_from_model[:3, :3])) ** (1 / 3)
        for image in dataset.images()
        for a in dataset.annotations(*image)
    ]
    assert 1.003 < max(scales) < 1.01


def test_vsd_delta_must_be_positive(tiny_bop):
    with pytest.raises(ValueError, match="vsd_delta must be positive"):
        BopDataset(tiny_bop, vsd_delta=0.0)

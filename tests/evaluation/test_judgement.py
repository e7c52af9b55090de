from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from foundpose.bop import BopDataset, ground_truth_instances
from foundpose.evaluation.judgement import judge
from foundpose.geometry import axis_rotation_to_ray, make_transform
from foundpose.rendering import Mesh, load_mesh


@pytest.fixture(scope="module")
def dataset(tiny_bop):
    return BopDataset(tiny_bop)


@pytest.fixture(scope="module")
def first(dataset):
    """The first instance, its true pose, and its object with two templates: the right one and one from behind."""
    instance = ground_truth_instances(dataset)[0]
    T = dataset.annotations(instance.scene_id, instance.im_id)[0].T_camera_from_model
    R = axis_rotation_to_ray(T[None, :3, 3])[0] @ T[:3, :3]
    behind = turned(T, (0, 180, 0))[:3, :3]
    views = make_transform(torch.stack([R, behind]), torch.zeros(2, 3).double()).float()
    mesh = load_mesh(dataset.mesh_path(instance.obj_id))
    objects = SimpleNamespace(
        mesh=lambda _: mesh, representations=lambda _: [SimpleNamespace(T_template_from_model=views)]
    )
    return instance, T, objects


def turned(T, degrees):
    """A pose turned in place, by angles about the camera's axes."""
    R = torch.from_numpy(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix())
    return make_transform(R @ T[:3, :3], T[:3, 3])


def record(instance, T, **changes):
    ids = {"scene_id": instance.scene_id, "im_id": instance.im_id, "obj_id": instance.obj_id}
    pose = {"valid": True, "status": "OK", "R": T[:3, :3].tolist(), "t": T[:3, 3].tolist()}
    return ids | pose | {"num_inliers": 90, "num_patches": 100, "templates": [1]} | changes


def judged(dataset, first, T, **changes):
    instance, _, objects = first
    return judge(dataset, objects, [record(instance, T, **changes)], [instance])[0]


def test_the_truth_is_right_and_has_no_error(dataset, first):
    j = judged(dataset, first, first[1])
    assert j.reason == "right"
    assert max(j.mssd, j.mspd, j.rotation, j.translation) < 1e-3
    assert j.overlap == 1.0


def test_errors_are_told_apart(dataset, first):
    T = first[1]
    away = T.clone()
    away[:3, 3] *= 1.5
    away[0, 3] += 100.0
    assert judged(dataset, first, away).reason == "misplaced"
    assert judged(dataset, first, turned(T, (0, 180, 0))).reason == "mirrored"
    tilted = turned(T, (0, 0, 90))
    assert judged(dataset, first, tilted).reason == "wrong template"
    assert judged(dataset, first, tilted, templates=[1, 0]).reason == "wrong choice"
    assert judged(dataset, first, tilted, num_inliers=3).reason == "few inliers"
    assert judged(dataset, first, tilted).rotation == pytest.approx(90, abs=1e-3)


def test_a_ball_looks_the_same_from_everywhere(dataset, first):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=50)
    mesh = Mesh(torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces))
    objects = SimpleNamespace(mesh=lambda _: mesh, representations=first[2].representations)
    assert judged(dataset, (first[0], first[1], objects), turned(first[1], (0, 0, 90))).reason == "symmetric"


def test_masks_and_missing_poses(dataset, first):
    instance, T, objects = first
    size = list(dataset.image_size(instance.scene_id, instance.im_id))
    elsewhere = replace(instance, segmentation={"size": size, "counts": [0, 900, size[0] * size[1] - 900]})
    bad = judge(dataset, objects, [record(instance, turned(T, (0, 0, 90)))], [elsewhere])[0]
    assert bad.reason == "mask"
    assert bad.overlap == 0.0
    assert judged(dataset, first, T, valid=False, status="TOO_FEW_INLIERS").reason == "no pose"
    assert judged(dataset, first, T, valid=False, status="UNUSABLE_MASK").reason == "mask"
    other = 3 - instance.obj_id
    assert judge(dataset, objects, [record(instance, T, obj_id=other)])[0].reason == "not in the picture"


def test_without_masks_the_nearest_annotation_is_taken(dataset, first):
    instance, T, objects = first
    j = judge(dataset, objects, [record(instance, T)])[0]
    assert j.reason == "right"
    assert j.overlap is None

import copy
import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from lightning_fabric.utilities import move_data_to_device
from scipy.spatial import cKDTree

from foundpose.features import AdaptedExtractor
from foundpose.geometry import (
    PerspectiveCrop,
    SuperFibonacci,
    no_symmetries,
    project_points,
    rotation_angle,
    stack_symmetries,
    symmetries_from_models_info,
    transform_points,
)
from foundpose.onboarding import ArtefactStore
from foundpose.synthetic import LightVariation, cluttered_scene, procedural_mesh
from foundpose.training import (
    EpochShuffle,
    PairDataModule,
    PairSettings,
    make_pairs,
    nearby_rotations,
    render_crops,
)


def test_nearby_rotations_are_within_bounds_and_spread():
    rotations = SuperFibonacci(500)()
    near = nearby_rotations(rotations, 5.0, 35.0, torch.Generator().manual_seed(0))
    angle = torch.rad2deg(rotation_angle(near, rotations))
    assert angle.min() >= 4.99
    assert angle.max() <= 35.01
    # Even between the bounds, about axes of all directions.
    assert abs(angle.mean() - 20.0) < 1.5
    turn = near @ rotations.transpose(1, 2)
    axis = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]]
    )
    assert torch.nn.functional.normalize(axis, dim=0).mean(dim=1).norm() < 0.1
    again = nearby_rotations(rotations, 5.0, 35.0, torch.Generator().manual_seed(0))
    assert torch.equal(near, again)
    with pytest.raises(ValueError, match=r"got 35\.0 and 5\.0"):
        nearby_rotations(rotations, 35.0, 5.0, torch.Generator())


def test_crops_show_the_object_at_the_true_pose(bodies, sift_onboarder, crop):
    found = render_crops(bodies[0], [1, 2, 3], crop, sift_onboarder.renderer, occlusion=False)
    assert found.crops.valid.all()
    render = sift_onboarder.renderer(
        bodies[0], found.T_crop_from_model, found.crops.K_crop, found.crops.masks.shape[1:]
    )
    inside = found.crops.masks > 0.5
    overlap = (inside & render.mask).sum((1, 2)) / (inside | render.mask).sum((1, 2))
    assert overlap.min() > 0.97
    with pytest.raises(ValueError, match="seeds is empty"):
        render_crops(bodies[0], [], crop, sift_onboarder.renderer)


def test_light_changes_the_picture_and_nothing_else(bodies):
    plain = cluttered_scene(bodies[0], 5)
    scenes = [cluttered_scene(bodies[0], 5, light=LightVariation(ambient=(a, a))) for a in (0.1, 0.9)]
    for scene in scenes:
        assert torch.equal(scene.mask, plain.mask)
        assert torch.equal(scene.T_camera_from_model, plain.T_camera_from_model)
    # Little ambient light: the side away from the lamp is dark.
    dark, bright = (scene.image.mean(0)[scene.mask] for scene in scenes)
    assert dark.quantile(0.05) < 0.6 * bright.quantile(0.05)
    # A white sphere under one lamp: Lambert's law, up to noise.
    ball = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    mesh = procedural_mesh(0, subdivisions=4)
    mesh = type(mesh)(
        torch.tensor(ball.vertices).float(), torch.tensor(ball.faces), torch.ones(len(ball.vertices), 3)
    )
    lamp = LightVariation(ambient=(0.0, 0.0), tilt=60.0, brightness=(1, 1), gain=(1, 1), noise=(0, 0))
    scene = cluttered_scene(mesh, 4, occlusion=False, light=lamp)
    v, u = torch.nonzero(scene.mask, as_tuple=True)
    rays = torch.stack([u, v, torch.ones_like(u)], -1).float() @ torch.linalg.inv(scene.K).T
    rays = rays / rays.norm(dim=-1, keepdim=True)
    centre = scene.T_camera_from_model[:3, 3]
    along = rays @ centre
    depth = along - (along.square() - centre.square().sum() + 50.0**2).clamp(min=0).sqrt()
    normals = (rays * depth[:, None] - centre) / 50.0
    value = scene.image.mean(0)[v, u]
    lit = value > 0.05
    to_lamp = torch.linalg.lstsq(normals[lit], value[lit, None]).solution[:, 0]
    assert abs(to_lamp.norm() - 1.0) < 0.02
    assert to_lamp[2] < -0.45  # at most 60 degrees from the camera
    assert (normals[lit] @ to_lamp - value[lit]).abs().mean() < 0.02


def test_pairs_are_true(pairs, bodies):
    batch = pairs.__getitems__(range(len(pairs)))
    assert len(pairs) == 2 * 8 * 2
    for number, mesh in enumerate(bodies):
        rows = slice(16 * number, 16 * (number + 1))
        valid = batch.template_valid[rows]
        points = batch.template_points[rows][valid][::20].numpy()
        triangles = mesh.vertices[mesh.faces].numpy()
        near = cKDTree(triangles.mean(1)).query(points, k=20)[1]
        repeated = points.repeat(20, 0)
        on_triangles = trimesh.triangles.closest_point(triangles[near.ravel()], repeated)
        distance = np.linalg.norm(on_triangles - repeated, axis=1).reshape(-1, 20).min(1)
        assert distance.max() < 0.02
        assert torch.allclose(batch.diameter[rows], torch.tensor(float(mesh.diameter)))
    # The crop's patches lie on the object as the true pose shows it.
    pixels, depth = project_points(transform_points(batch.T_crop_from_model, batch.surface), batch.K_crop)
    assert (depth > 0).all()
    spread = pixels.amax(1) - pixels.amin(1)
    middle = (pixels.amax(1) + pixels.amin(1)) / 2
    offset = (batch.query_pixels - middle[:, None]).abs() / spread[:, None]
    assert offset[batch.query_valid].max() < 0.6
    assert batch.query_valid.sum(1).min() > 30
    # Both pairs of a crop share it but not the template.
    assert torch.equal(batch.query_descriptors[0], batch.query_descriptors[1])
    assert not torch.equal(batch.template_points[0], batch.template_points[1])


def test_pairs_follow_the_seed_alone(pairs, bodies, sift_onboarder, crop, settings):
    chunks = copy.copy(sift_onboarder)
    chunks.batch_size = 3
    again = make_pairs(bodies, chunks, crop, settings, seed=3)
    assert set(again.tensors) == set(pairs.tensors)
    for name, value in pairs.tensors.items():
        # The convolutions inside SIFT round by the size of the batch.
        assert torch.allclose(again.tensors[name], value, atol=1e-5), name
    few = dataclasses.replace(settings, crops_per_mesh=1)
    other = make_pairs(bodies[:1], sift_onboarder, crop, few, seed=4)[0]
    assert not torch.allclose(other.T_crop_from_model, pairs[0].T_crop_from_model, atol=0.1)


def test_cache(bodies, sift_onboarder, crop, settings, tmp_path, monkeypatch):
    few = dataclasses.replace(settings, crops_per_mesh=2)
    steps, cache = [], ArtefactStore(tmp_path)

    def make(onboarder=sift_onboarder, seed=0):
        steps.clear()
        return make_pairs(
            bodies[:1], onboarder, crop, few, seed, cache, lambda stage, done, total: steps.append(done)
        )

    first = make()
    assert steps == [2]
    second = make()
    assert steps == []
    for name, value in first.tensors.items():
        assert torch.equal(second.tensors[name], value), name
    make(seed=1)
    assert steps == [2]
    other = copy.copy(sift_onboarder)
    other.extractor = AdaptedExtractor(sift_onboarder.extractor)
    make(other)
    assert steps == [2]
    black = PerspectiveCrop(crop.size, crop.fill, background="black")
    make_pairs(bodies[:1], sift_onboarder, black, few, 0, cache)
    monkeypatch.setattr(type(sift_onboarder.extractor), "running_precision", lambda _: "bf16")
    make()
    assert steps == [2]
    assert len(cache.entries()) == 5


def test_symmetries_go_with_their_objects(bodies, sift_onboarder, crop, settings, tmp_path):
    few = dataclasses.replace(settings, crops_per_mesh=1, templates_per_crop=1)
    spin = symmetries_from_models_info({"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [1, 2, 3]}]})
    both = stack_symmetries([spin, symmetries_from_models_info({})])

    def make(symmetries):
        data = PairDataModule(bodies, [], sift_onboarder, crop, few, cache=tmp_path, symmetries=symmetries)
        data.setup()
        return data.training

    assert make(None)[0].symmetries is None
    found = make(both)
    # They change no picture.
    assert len(ArtefactStore(tmp_path).entries()) == 1
    batch = found.__getitems__([1, 0, 1])
    assert batch.symmetries.axis_valid.tolist() == [[False], [True], [False]]
    assert batch.symmetries.origins[1].tolist() == [[1.0, 2.0, 3.0]]
    batch.symmetries.check(3, batch.surface)
    # Lightning moves them along.
    moved = move_data_to_device(batch, torch.device("meta"))
    assert moved.symmetries.axes.device == moved.surface.device == torch.device("meta")
    with pytest.raises(ValueError, match="with B = 2"):
        make(no_symmetries(3))


def test_batches_are_padded(pairs):
    whole = pairs.__getitems__([0, 9, 31])
    for row, index in enumerate((0, 9, 31)):
        alone = pairs[index]
        for name in ("query", "template"):
            count = int(getattr(alone, f"{name}_valid").sum())
            assert int(getattr(whole, f"{name}_valid")[row].sum()) == count
            descriptors = getattr(whole, f"{name}_descriptors")[row]
            assert torch.equal(descriptors[:count], getattr(alone, f"{name}_descriptors")[0, :count])
            assert (descriptors[count:] == 0).all()
    with pytest.raises(IndexError):
        pairs[len(pairs)]


def test_order_depends_on_seed_and_epoch():
    sampler, again, other = EpochShuffle(50, 0), EpochShuffle(50, 0), EpochShuffle(50, 1)
    first = list(sampler)
    assert sorted(first) == list(range(50))
    assert list(again) == first
    assert list(other) != first
    sampler.set_epoch(3)
    again.set_epoch(3)
    assert list(sampler) == list(again) != first


def test_bad_settings(bodies, sift_onboarder, crop, settings):
    with pytest.raises(ValueError, match="at least 1"):
        PairSettings(crops_per_mesh=0)
    with pytest.raises(ValueError, match="max_degrees"):
        PairSettings(min_degrees=40.0)
    with pytest.raises(ValueError, match="meshes is empty"):
        make_pairs([], sift_onboarder, crop, settings, 0)
    with pytest.raises(ValueError, match="420 px wide, templates 280 px"):
        make_pairs(bodies, sift_onboarder, type(crop)(420), settings, 0)
    with pytest.raises(ValueError, match=r"ambient must be \(low, high\)"):
        LightVariation(ambient=(0.9, 0.1))
    with pytest.raises(ValueError, match="tilt"):
        LightVariation(tilt=120.0)

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.bop.vsd import distance_images, visible_surfaces, vsd
from foundpose.bop.vsd_image import DepthImage, DepthObject, PosedObject, vsd_of_pairs
from foundpose.geometry import se3_exp
from foundpose.rendering import RaycastRenderer
from foundpose.rendering.mesh_files import read_mesh_file
from foundpose.synthetic import procedural_mesh

TAUS = [0.05 + 0.05 * k for k in range(10)]
SIZE = (48, 64)
K = torch.tensor([[60.0, 0.0, 30.2], [0.0, 61.0, 25.1], [0.0, 0.0, 1.0]], dtype=torch.float64)


def plain_vsd(est, true, test, intrinsics, taus, diameter, delta):
    """Pixel by pixel. Returns the values and the numbers of pixels (true, estimate, both, either)."""
    costs, counts = np.zeros(len(taus)), np.zeros(4, int)
    for v in range(est.shape[0]):
        for u in range(est.shape[1]):
            x = (u - intrinsics[0, 2]) / intrinsics[0, 0]
            y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
            length = math.sqrt(x * x + y * y + 1.0)
            e, t, m = est[v, u] * length, true[v, u] * length, test[v, u] * length
            in_true = t > 0 and (m == 0 or t - m <= delta)
            in_est = e > 0 and (m == 0 or e - m <= delta or in_true)
            counts += [in_true, in_est, in_true and in_est, in_true or in_est]
            if in_true and in_est:
                costs += [abs(e - t) / diameter >= tau for tau in taus]
            elif in_true or in_est:
                costs += 1
    return (costs / counts[3] if counts[3] else np.ones(len(taus))), counts


def random_depths(rng, batch):
    """Rendered and measured depths of about a metre, with gaps, occlusions and missing measurements."""
    est, true, test = 1000.0 + rng.normal(0, 20, (3, batch, *SIZE))
    for image, holes in ((est, 0.4), (true, 0.3), (test, 0.1)):
        image[rng.uniform(size=image.shape) < holes] = 0.0
    return torch.from_numpy(est), torch.from_numpy(true), torch.from_numpy(test)


@pytest.mark.parametrize(("shared_test", "shared_K"), [(False, False), (True, True)])
def test_equals_a_loop_over_pixels(rng, shared_test, shared_K):
    est, true, test = random_depths(rng, 3)
    intrinsics = K + torch.linspace(0, 5, 3, dtype=torch.float64)[:, None, None] * (K != 0) * (K != 1)
    diameters = torch.tensor([90.0, 130.0, 200.0], dtype=torch.float64)
    if shared_test:
        test = test[:1]
    if shared_K:
        intrinsics = intrinsics[:1]
    got = vsd(est, true, test, intrinsics, TAUS, diameters, delta=15.0)
    distances = [distance_images(image, intrinsics) for image in (est, true, test)]
    visible = visible_surfaces(*distances, delta=15.0)
    for i in range(3):
        test_image, K_image = test[i % len(test)], intrinsics[i % len(intrinsics)]
        images = (est[i].numpy(), true[i].numpy(), test_image.numpy())
        expected, counts = plain_vsd(*images, K_image.numpy(), TAUS, float(diameters[i]), 15.0)
        assert got[i].tolist() == expected.tolist()
        assert 0.3 < expected.min() < expected.max() < 0.99
        masks = (visible.true[i], visible.estimate[i])
        both, either = masks[0] & masks[1], masks[0] | masks[1]
        assert [int(m.sum()) for m in (*masks, both, either)] == counts.tolist()
    # Not the same with another tolerance or with depths in place of distances.
    assert (vsd(est, true, test, intrinsics, TAUS, diameters, delta=5.0) != got).any()
    assert torch.allclose(
        vsd(est.float(), true.float(), test.float(), intrinsics, TAUS, diameters).double(), got
    )


def test_rules_at_their_limits():
    """One pixel on the axis of the camera, where depth and distance agree."""
    camera = torch.eye(3, dtype=torch.float64)[None]

    def value(est, true, test, tau=0.5, diameter=40.0):
        images = [torch.tensor([[[z]]], dtype=torch.float64) for z in (est, true, test)]
        return float(vsd(*images, K=camera, taus=[tau], diameter=diameter, delta=15.0))

    assert value(1000.0, 1000.0, 1000.0) == 0.0
    assert value(1020.0, 1000.0, 1020.0) == 1.0  # half a diameter apart is too far
    assert value(1019.0, 1000.0, 1019.0) == 0.0
    assert value(1019.0, 1000.0, 0.0) == 0.0  # nothing measured: both visible
    assert value(1000.0, 1015.0, 1000.0) == 0.0  # exactly delta behind the measured surface is visible
    assert value(1000.0, 1016.0, 1000.0) == 1.0
    assert value(1016.0, 1015.0, 1000.0) == 0.0  # hidden, but visible since the truth is
    assert value(1016.0, 1016.0, 1000.0) == 1.0  # neither is visible: empty union
    assert value(0.0, 1000.0, 1000.0) == 1.0
    assert value(0.0, 0.0, 1000.0) == 1.0


def test_padding_windows_and_neighbours_change_nothing(rng):
    est, true, test = random_depths(rng, 4)
    for image in (est, true):
        image[:, :5], image[:, 40:], image[:, :, :7], image[:, :, 50:] = 0.0, 0.0, 0.0, 0.0
    whole = vsd(est, true, test, K[None], TAUS, 120.0)
    assert torch.equal(whole[2:3], vsd(est[2:3], true[2:3], test[2:3], K[None], TAUS, 120.0))
    shifted = K.clone()
    shifted[:2, 2] -= torch.tensor([7.0, 5.0])
    cut = [torch.nn.functional.pad(image[:, 5:40, 7:50], (0, 9, 0, 4)) for image in (est, true, test)]
    assert torch.allclose(vsd(*cut, K=shifted[None], taus=TAUS, diameter=120.0), whole, rtol=0, atol=1e-15)


def test_wrong_shapes_are_named():
    image = torch.zeros(2, 4, 5)
    with pytest.raises(ValueError, match=r"both have shape \(B, H, W\), got \(2, 4, 5\) and \(4, 5\)"):
        vsd(image, image[0], image, K[None], TAUS, 1.0)
    with pytest.raises(ValueError, match=r"depth_test must have shape .* got \(3, 4, 5\)"):
        vsd(image, image, torch.zeros(3, 4, 5), K[None], TAUS, 1.0)
    with pytest.raises(ValueError, match=r"K must have shape \(2, 3, 3\) or \(1, 3, 3\), got \(3, 3\)"):
        vsd(image, image, image, K, TAUS, 1.0)
    with pytest.raises(ValueError, match="share a floating dtype"):
        vsd(image, image, image.double(), K[None], TAUS, 1.0)


def pose(axis_angle, translation):
    T = se3_exp(torch.tensor([0.0, 0.0, 0.0, *axis_angle], dtype=torch.float64))
    T[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return T


@pytest.fixture(scope="module")
def scene():
    """Two objects, six estimates and three truths in an image, with occlusions; every estimate against its kind."""
    meshes = [procedural_mesh(seed, subdivisions=4) for seed in (1, 2)]
    objects = [DepthObject(m.vertices, m.faces, m.diameter) for m in meshes]
    d = [m.diameter for m in meshes]
    truths = [(0, pose([0.1, 0, 0], [0, 0, 6 * d[0]])), (1, pose([0, 1, 0], [d[1], 0, 7 * d[1]]))]
    truths.append((0, pose([0, 0, 1], [-0.5 * d[0], 0.2 * d[0], 5 * d[0]])))
    estimates = [
        (0, pose([0.15, 0, 0.1], [3, 1, 6.05 * d[0]])),
        (0, pose([0, 0.2, 1], [-0.5 * d[0], 0.25 * d[0], 5.1 * d[0]])),
        (0, pose([0, 0, 0], [2 * d[0], -d[0], 6 * d[0]])),  # far from every truth
        (1, pose([0, 1.1, 0], [1.02 * d[1], 5, 7 * d[1]])),
        (1, pose([0, 1, 0], [0.9 * d[1], 0, 3 * d[1]])),  # cut by the border
        (1, pose([0, 0, 0], [0, 0, float("nan")])),
    ]
    pairs = torch.tensor(
        [[i, j] for i, e in enumerate(estimates) for j, t in enumerate(truths) if e[0] == t[0]]
    )
    camera = torch.tensor([[400.0, 0, 160.3], [0, 405.0, 118.9], [0, 0, 1]], dtype=torch.float64)
    return meshes, objects, estimates, truths, pairs, camera


def test_pairs_in_windows_equal_whole_images(scene, monkeypatch):
    meshes, objects, estimates, truths, pairs, camera = scene
    size = (240, 320)
    half = torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], dtype=torch.float64)
    renderer = RaycastRenderer(supersampling=1)

    def whole(items):
        depths = [renderer(meshes[k], T[None], (camera - half)[None], size).depth[0] for k, T in items]
        return torch.stack(depths).float().double()

    est, true = whole(estimates), whole(truths)
    measured = torch.where(true > 0, true, torch.inf).amin(0)
    measured = torch.where(measured.isinf(), 0.0, measured)
    measured[:, 150:170] = 300.0  # something in front
    diameters = torch.tensor([meshes[estimates[i][0]].diameter for i in pairs[:, 0]])
    i, j = pairs.T
    expected = vsd(est[i], true[j], measured.round()[None], camera[None], TAUS, diameters)
    posed = [[PosedObject(objects[k], T) for k, T in items] for items in (estimates, truths)]
    arguments = (*posed, pairs, DepthImage(measured.round().float(), camera), TAUS)
    got = vsd_of_pairs(*arguments)
    assert torch.allclose(got, expected, rtol=0, atol=1e-12)
    assert (got < 0.5).any()
    assert got[pairs[:, 0] == 5].eq(1.0).all()
    monkeypatch.setattr("foundpose.bop.vsd_image._PIXELS_PER_CHUNK", 1)
    assert torch.allclose(vsd_of_pairs(*arguments), expected, rtol=0, atol=1e-12)


def test_only_what_a_pair_needs_is_rendered(scene, monkeypatch):
    _, objects, estimates, truths, pairs, camera = scene
    rendered = []
    original = DepthObject.render
    monkeypatch.setattr(
        DepthObject, "render", lambda self, view: rendered.append(view) or original(self, view)
    )
    posed = [[PosedObject(objects[k], T) for k, T in items] for items in (estimates, truths)]
    vsd_of_pairs(*posed, pairs, DepthImage(torch.zeros(240, 320), camera), TAUS)
    assert len(rendered) == 3 + 4
    assert vsd_of_pairs(
        [], [], torch.zeros(0, 2, dtype=torch.int64), DepthImage(torch.zeros(9, 9), camera), TAUS
    ).shape == (0, 10)
    assert len(rendered) == 7


def test_equals_the_toolkit_on_a_depth_image_of_lmo(lmo_root):
    folder = lmo_root.parent / "bop_reference" / "vsd"
    if not (folder / "vsd.json").is_file():
        pytest.skip(f"no reference numbers at {folder}")
    reference = json.loads((folder / "vsd.json").read_text())
    info = json.loads((lmo_root / "models_eval" / "models_info.json").read_text())
    image, cases, truth = reference["image"], reference["cases"], reference["gt"]
    depth = (
        torch.from_numpy(np.asarray(Image.open(folder / image["depth"])).astype(np.float32))
        * image["depth_scale"]
    )
    camera = torch.tensor(image["cam_K"], dtype=torch.float64).reshape(3, 3)
    objects = {}
    for obj_id in {entry["obj_id"] for entry in truth}:
        mesh = read_mesh_file(lmo_root / "models_eval" / f"obj_{obj_id:06d}.ply")
        arrays = (torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces))
        objects[obj_id] = DepthObject(*arrays, info[str(obj_id)]["diameter"])

    def posed(entry):
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = torch.tensor(entry["R"], dtype=torch.float64).reshape(3, 3)
        T[:3, 3] = torch.tensor(entry["t"], dtype=torch.float64)
        return PosedObject(objects[entry["obj_id"]], T)

    estimates, truths = [posed(c) for c in cases], [posed(g) for g in truth]
    pairs = torch.tensor([[i, c["gt_idx"]] for i, c in enumerate(cases)])
    taus = reference["parameters"]["taus"]
    assert taus == TAUS
    assert len(cases) == 43
    got = vsd_of_pairs(
        estimates, truths, pairs, DepthImage(depth, camera), taus, reference["parameters"]["delta_mm"]
    )
    expected = torch.tensor([c["vsd"] for c in cases], dtype=torch.float64)
    union = torch.tensor([c["px"]["union"] for c in cases])[:, None]
    assert ((got - expected).abs() * union).max() <= 3
    empty = vsd_of_pairs(
        estimates[:1], truths[:1], pairs[:1], DepthImage(torch.ones_like(depth), camera), taus
    )
    assert empty[0].tolist() == reference["no_visible_pixel"]["vsd"]

    def distances(item):
        view = item.object.view(item.T_camera_from_model, camera, tuple(depth.shape))
        left, top, right, bottom = view.window
        whole = torch.zeros(1, *depth.shape, dtype=torch.float64)
        whole[0, top:bottom, left:right] = torch.from_numpy(item.object.render(view))
        return distance_images(whole, camera[None])

    measured = distance_images(depth.double()[None], camera[None])
    for estimate, case in zip(estimates, cases, strict=True):
        visible = visible_surfaces(distances(estimate), distances(truths[case["gt_idx"]]), measured, 15.0)
        counts = {
            "visib_gt": visible.true,
            "visib_est": visible.estimate,
            "inter": visible.true & visible.estimate,
            "union": visible.true | visible.estimate,
        }
        for name, mask in counts.items():
            assert abs(int(mask.sum()) - case["px"][name]) <= 3, (case["case"], name)

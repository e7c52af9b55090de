"""A small annotated dataset with several instances, a symmetric object and depth, and a plain way to score on it."""

import json
import math
from collections import defaultdict

import numpy as np
import torch
import trimesh
from PIL import Image

from foundpose.bop.results import PoseResult
from foundpose.geometry import se3_exp
from foundpose.rendering import Mesh, RaycastRenderer, load_mesh

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Symmetry of object 1 about its z axis."""

BOXES = {1: (60.0, 60.0, 110.0), 3: (80.0, 50.0, 30.0)}
FRACTIONS = [0.05 + 0.05 * k for k in range(10)]


def random_pose(rng, depth=(500.0, 700.0), aside=70.0):
    """A pose (4, 4) float64 in front of the camera."""
    T = se3_exp(torch.from_numpy(np.concatenate([np.zeros(3), rng.normal(size=3)])))
    T[:3, 3] = torch.tensor([*rng.uniform(-aside, aside, 2), rng.uniform(*depth)])
    return T


def make_scored_dataset(root, rng, images=8, with_depth=True):
    """Write a dataset of two boxes. Sizes of images differ; a target may ask for fewer instances than there are."""
    for folder in ("models", "models_eval", "test/000005/rgb", "test/000005/depth"):
        (root / folder).mkdir(parents=True)
    info = {str(k): {"diameter": float(np.linalg.norm(sides))} for k, sides in BOXES.items()}
    info["1"]["symmetries_discrete"] = [HALF_TURN.flatten().tolist()]
    meshes = {}
    for obj_id, sides in BOXES.items():
        for folder in ("models", "models_eval"):
            path = root / folder / f"obj_{obj_id:06d}.ply"
            trimesh.creation.box(sides).export(path)
            (root / folder / "models_info.json").write_text(json.dumps(info))
        meshes[obj_id] = load_mesh(path)
    cameras, truth, truth_info, targets = {}, {}, {}, []
    for im_id in range(images):
        width, height = (160, 96) if im_id % 2 else (120, 100)
        K = [150.0 + im_id, 0.0, width / 2 + 0.3, 0.0, 152.0, height / 2 - 0.7, 0.0, 0.0, 1.0]
        cameras[str(im_id)] = {"cam_K": K, "depth_scale": 0.5}
        entries, infos, nearest = [], [], np.full((height, width), np.inf)
        for obj_id in BOXES:
            count = int(rng.integers(1, 4))
            for _ in range(count):
                T = random_pose(rng)
                entries.append(
                    {
                        "cam_R_m2c": (T[:3, :3] * 1.004).flatten().tolist(),
                        "cam_t_m2c": T[:3, 3].tolist(),
                        "obj_id": obj_id,
                    }
                )
                # Few distinct values: equal visibilities are common.
                infos.append({"visib_fract": float(rng.choice([0.05, 0.5, 0.9]))})
                K_matrix = torch.tensor(K, dtype=torch.float64).reshape(1, 3, 3)
                depth = (
                    RaycastRenderer(1)(meshes[obj_id], T[None], K_matrix, (height, width)).depth[0].numpy()
                )
                nearest = np.where(depth > 0, np.minimum(nearest, depth), nearest)
            wanted = int(rng.integers(1, count + 1))
            targets.append({"scene_id": 5, "im_id": im_id, "obj_id": obj_id, "inst_count": wanted})
        order = rng.permutation(len(entries))
        truth[str(im_id)] = [entries[i] for i in order]
        truth_info[str(im_id)] = [infos[i] for i in order]
        Image.new("RGB", (width, height)).save(root / f"test/000005/rgb/{im_id:06d}.png")
        if with_depth:
            measured = np.where(np.isinf(nearest), 900.0, nearest) + rng.normal(0, 4, nearest.shape)
            measured[rng.uniform(size=measured.shape) < 0.1] = 0.0
            raw = (measured / 0.5).round().astype(np.uint16)
            Image.fromarray(raw).save(root / f"test/000005/depth/{im_id:06d}.png")
    scene = root / "test" / "000005"
    for name, content in (("camera", cameras), ("gt", truth), ("gt_info", truth_info)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    bop24 = [{"scene_id": 5, "im_id": im_id} for im_id in range(images)]
    (root / "test_targets_bop24.json").write_text(json.dumps(bop24))
    return root


def random_results(dataset, rng):
    """Estimates near and far, flipped, doubled, of equal scores, outside the targets; none for some targets."""
    results = []
    for scene_id, im_id in dataset.images():
        for annotation in dataset.annotations(scene_id, im_id):
            for _ in range(int(rng.integers(0, 3))):
                twist = rng.normal(size=6) * rng.choice([0.02, 0.1, 0.6])
                twist[:3] *= 40.0
                T = annotation.T_camera_from_model.clone()
                motion = se3_exp(torch.from_numpy(twist))
                T[:3, :3] = motion[:3, :3] @ T[:3, :3]
                T[:3, 3] += motion[:3, 3]
                if annotation.obj_id == 1 and rng.uniform() < 0.5:
                    T = T @ torch.from_numpy(HALF_TURN)
                score = float(rng.choice([0.2, 0.5, 0.8]))
                results.append(PoseResult(scene_id, im_id, annotation.obj_id, score, T, 0.25 * im_id))
    results += [
        PoseResult(5, 0, 77, 1.0, random_pose(rng), 0.0),
        PoseResult(9, 0, 1, 1.0, random_pose(rng), 3.0),
    ]
    return [results[i] for i in rng.permutation(len(results))]


def plain_recalls(dataset, results, delta=15.0):
    """Found instances by function, object and threshold, one pair after the other in NumPy."""
    found = {name: defaultdict(lambda: 0) for name in ("mssd", "mspd", "vsd")}
    for target in dataset.targets():
        scene_id, im_id, obj_id, count = target
        K = dataset.intrinsics(scene_id, im_id).numpy()
        height, width = dataset.image_size(scene_id, im_id)
        mesh = load_mesh(dataset.evaluation_mesh_path(obj_id))
        diameter = float(np.linalg.norm(BOXES[obj_id]))
        truths = [a for a in dataset.annotations(scene_id, im_id) if a.obj_id == obj_id]
        truths = sorted(truths, key=lambda a: -a.visible_fraction)[:count]
        mine = [r for r in results if (r.scene_id, r.im_id, r.obj_id) == target[:3]]
        mine = sorted(mine, key=lambda r: -r.score)[:count]
        test = dataset.depth(scene_id, im_id).double().numpy()
        errors = {"mssd": [], "mspd": [], "vsd": []}
        for result in mine:
            T = result.T_camera_from_model
            rows = [_pair(mesh, obj_id, T.numpy(), a.T_camera_from_model.numpy(), K) for a in truths]
            errors["mssd"].append([row[0] / diameter for row in rows])
            errors["mspd"].append([row[1] * 640 / width for row in rows])
            true = [_depth(mesh, a.T_camera_from_model, K, (height, width)) for a in truths]
            est = _depth(mesh, T, K, (height, width))
            errors["vsd"].append([_vsd(est, t, test, K, diameter, delta) for t in true])
        for name, table in errors.items():
            thresholds = [5.0 * k for k in range(1, 11)] if name == "mspd" else FRACTIONS
            for tau in range(10 if name == "vsd" else 1):
                one = [[e[tau] if name == "vsd" else e for e in row] for row in table]
                for k, threshold in enumerate(thresholds):
                    key = (obj_id, tau, k) if name == "vsd" else (obj_id, k)
                    found[name][key] += _greedy(one, len(truths), threshold)
    return found


def _greedy(errors, annotations, threshold):
    free = list(range(annotations))
    for row in errors:
        best = min(free, key=lambda j: row[j], default=None)
        if best is not None and row[best] < threshold:
            free.remove(best)
    return annotations - len(free)


def plain_errors(dataset, result, annotation):
    """MSSD in diameters and MSPD scaled, of one estimate and one annotation."""
    image = (result.scene_id, result.im_id)
    box = trimesh.creation.box(BOXES[result.obj_id])
    mesh = Mesh(torch.from_numpy(np.array(box.vertices)), torch.from_numpy(np.array(box.faces)))
    est, true = result.T_camera_from_model.numpy(), annotation.T_camera_from_model.numpy()
    mssd, mspd = _pair(mesh, result.obj_id, est, true, dataset.intrinsics(*image).numpy())
    diameter = float(np.linalg.norm(BOXES[result.obj_id]))
    return {"mssd": mssd / diameter, "mspd": mspd * 640 / dataset.image_size(*image)[1]}


def _pair(mesh, obj_id, est, true, K):
    points = np.c_[mesh.vertices.double().numpy(), np.ones(len(mesh.vertices))]
    best = [math.inf, math.inf]
    for symmetry in [np.eye(4), HALF_TURN] if obj_id == 1 else [np.eye(4)]:
        a, b = ((T @ points.T)[:3] for T in (est, true @ symmetry))
        best[0] = min(best[0], np.linalg.norm(a - b, axis=0).max())
        pixels = [(K @ x)[:2] / x[2] for x in (a, b)]
        best[1] = min(best[1], np.linalg.norm(pixels[0] - pixels[1], axis=0).max())
    return best


def _depth(mesh, T, K, size):
    K_render = torch.from_numpy(K).clone()
    K_render[:2, 2] -= 0.5
    return RaycastRenderer(1)(mesh, T[None], K_render[None], size).depth[0].float().double().numpy()


def _vsd(est, true, test, K, diameter, delta):
    v, u = np.mgrid[: est.shape[0], : est.shape[1]]
    length = np.sqrt(((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2 + 1)
    est, true, test = est * length, true * length, test * length
    in_true = (true > 0) & ((true - test <= delta) | (test == 0))
    in_est = (est > 0) & ((est - test <= delta) | (test == 0) | in_true)
    both, either = in_true & in_est, in_true | in_est
    if not either.any():
        return [1.0] * 10
    apart = np.abs(est - true)[both] / diameter
    return [float(((apart >= tau).sum() + (either & ~both).sum()) / either.sum()) for tau in FRACTIONS]

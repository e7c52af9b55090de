import csv
import json
import math
import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.utils._python_dispatch import TorchDispatchMode

from foundpose.bop.errors import ModelErrors, add, adi, mspd, mssd
from foundpose.geometry import make_transform, se3_exp
from foundpose.rendering import load_mesh
from foundpose.synthetic import procedural_mesh
from tests.bop import numpy_errors as reference

K = torch.tensor([[[572.0, 0.5, 325.0], [0.0, 573.0, 242.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
AXIS = {"axis": [1.0, 2.0, 2.0], "offset": [5.0, -3.0, 2.0]}
FLIP = [1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, 1.0]
ENTRIES = {
    "none": {"diameter": 100.0},
    "discrete": {"diameter": 100.0, "symmetries_discrete": [FLIP]},
    "continuous": {"diameter": 100.0, "symmetries_continuous": [AXIS]},
    "both": {
        "diameter": 100.0,
        "symmetries_discrete": [FLIP],
        "symmetries_continuous": [{"axis": [0.0, 0.0, 1.0], "offset": [0.0, 0.0, 0.0]}],
    },
}


def body(seed=0, subdivisions=3):
    return procedural_mesh(seed, subdivisions=subdivisions).vertices.double()


def vase(rings=40, around=48):
    """A body of revolution about z, whose symmetries are nearly tied for many poses."""
    h = np.linspace(-50, 50, rings)
    r = 20 + 10 * np.sin(h / 20) + 5 * np.cos(h / 7)
    angle = np.arange(around) * 2 * np.pi / around
    x, y = r[:, None] * np.cos(angle), r[:, None] * np.sin(angle)
    return torch.from_numpy(np.stack([x.ravel(), y.ravel(), np.repeat(h, around)], axis=1))


def pose_pairs(count, seed=0, kind="mixed"):
    """Estimates near the truth, at random, and turned upside down."""
    rng = np.random.default_rng(seed)
    T_true = np.tile(np.eye(4), (count, 1, 1))
    T_true[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    T_true[:, :3, 3] = rng.uniform([-100, -100, 500], [100, 100, 900], (count, 3))
    turn = Rotation.from_rotvec(rng.normal(size=(count, 3)) * rng.choice([0.05, 1.0], (count, 1)))
    spin = Rotation.from_rotvec(np.c_[np.zeros((count, 2)), rng.uniform(0, 7, count)]).as_matrix()
    T_est = T_true.copy()
    T_est[:, :3, :3] = turn.as_matrix() @ T_true[:, :3, :3] @ spin
    T_est[:, :3, 3] += rng.normal(size=(count, 3)) * [3, 3, 20]
    if kind == "flipped":
        T_est = T_true.copy()
        T_est[:, :3, :3] = T_true[:, :3, :3] @ np.diag([1.0, -1.0, -1.0]) @ spin
    return torch.from_numpy(T_est), torch.from_numpy(T_true)


def by_numpy(model, T_est, T_true, K):
    arrays = [x.numpy() for x in (model.vertices, model.symmetries)]
    K = K.expand(len(T_est), 3, 3).numpy()
    pairs = list(zip(T_est.numpy(), T_true.numpy(), K, strict=True))
    return (
        np.array([reference.mssd(a, b, *arrays) for a, b, _ in pairs]),
        np.array([reference.mspd(a, b, k, *arrays) for a, b, k in pairs]),
    )


@pytest.mark.parametrize("name", ENTRIES)
@pytest.mark.parametrize("kind", ["mixed", "flipped"])
def test_errors_are_those_of_the_loop(name, kind):
    step = 0.05  # 63 angles
    for vertices in (body(), vase()):
        model = ModelErrors.from_models_info(vertices, ENTRIES[name], step=step)
        assert model.symmetric == (name != "none")
        pairs = pose_pairs(8, seed=3, kind=kind)
        for ours, theirs in zip(model(*pairs, K), by_numpy(model, *pairs, K), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11)


def test_random_symmetries_scaled_truth_and_cameras_of_their_own():
    rng = np.random.default_rng(1)
    symmetries = np.tile(np.eye(4), (100, 1, 1))
    symmetries[1:, :3, :3] = Rotation.random(99, random_state=1).as_matrix()
    symmetries[1:, :3, 3] = rng.normal(size=(99, 3)) * 5
    model = ModelErrors(body(), torch.from_numpy(symmetries), 100.0)
    T_est, T_true = pose_pairs(10)
    T_true[:, :3, :3] *= torch.from_numpy(rng.uniform(0.98, 1.02, 10))[:, None, None]
    cameras = K.repeat(10, 1, 1)
    cameras[:, :2] *= torch.from_numpy(rng.uniform(0.5, 2.0, (10, 2, 1)))
    wanted = by_numpy(model, T_est, T_true, cameras)
    for ours, theirs in zip(model(T_est, T_true, cameras), wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11)
    single = (x.float() for x in (T_est, T_true, cameras))
    for ours, theirs in zip(model.float()(*single), wanted, strict=True):
        assert ours.dtype == torch.float32
        np.testing.assert_allclose(ours, theirs, atol=1e-3)


def lmo_workload(lmo_root):
    """Estimates, truths, cameras and reference errors by object, as (n, 4, 4), (n, 4, 4), (n, 3, 3) and lists."""
    folder = lmo_root.parent / "bop_reference"
    if not folder.is_dir():
        pytest.skip(f"no reference numbers at {folder}")
    scene = lmo_root / "test" / "000002"
    truth, cameras = (
        json.loads((scene / name).read_text()) for name in ("scene_gt.json", "scene_camera.json")
    )
    with (folder / "megapose_lmo50.csv").open() as file:
        estimates = list(csv.DictReader(file))
    work = {}
    for row in json.loads((folder / "errors_mssd_mspd.json").read_text())["rows"]:
        estimate = estimates[row["row"]]
        for error in row["errors"]:
            annotation = truth[str(row["im_id"])][error["gt_idx"]]
            assert int(estimate["obj_id"]) == row["obj_id"] == annotation["obj_id"]
            lists = work.setdefault(row["obj_id"], ([], [], [], []))
            lists[0].append(matrix(*([float(x) for x in estimate[key].split()] for key in "Rt")))
            lists[1].append(matrix(annotation["cam_R_m2c"], annotation["cam_t_m2c"]))
            lists[2].append(torch.tensor(cameras[str(row["im_id"])]["cam_K"], dtype=torch.float64).view(3, 3))
            lists[3].append(error)
    info = json.loads((lmo_root / "models_eval" / "models_info.json").read_text())
    models = {
        obj_id: ModelErrors.from_models_info(lmo_vertices(lmo_root, obj_id), info[str(obj_id)])
        for obj_id in work
    }
    return models, {obj_id: (*map(torch.stack, lists[:3]), lists[3]) for obj_id, lists in work.items()}


def lmo_vertices(lmo_root, obj_id):
    return load_mesh(lmo_root / "models_eval" / f"obj_{obj_id:06d}.ply").vertices.double()


def matrix(R, t):
    return make_transform(
        torch.tensor(R, dtype=torch.float64).view(3, 3), torch.tensor(t, dtype=torch.float64)
    )


@pytest.mark.filterwarnings("ignore:mesh")
def test_bop_toolkit_on_a_submission(lmo_root):
    models, work = lmo_workload(lmo_root)
    rows = 0
    for obj_id, (*poses, wanted) in work.items():
        rows += len(wanted)
        beyond = np.array([error["beyond_diameter"] for error in wanted])
        for dtype in (torch.float64, torch.float32):
            errors = models[obj_id].to(dtype)(*(x.to(dtype) for x in poses))
            for name, ours in errors._asdict().items():
                theirs = np.array([error[name] for error in wanted])
                if dtype == torch.float64:
                    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=0)
                else:
                    counted = ~beyond if name == "mspd" else slice(None)
                    np.testing.assert_allclose(ours.numpy()[counted], theirs[counted], rtol=0, atol=1e-3)
    assert rows == 415


def test_bop_toolkit_with_continuous_symmetries(lmo_root):
    path = lmo_root.parent / "bop_reference" / "symmetries.json"
    if not path.is_file():
        pytest.skip(f"no reference numbers at {path}")
    content = json.loads(path.read_text())
    entries = {entry["name"]: entry["model_info"] for entry in content["entries"]}
    camera = torch.tensor(content["cam_K"], dtype=torch.float64).view(1, 3, 3)
    vertices = lmo_vertices(lmo_root, 11)
    assert len(content["errors"]) == 9
    for case in content["errors"]:
        entry = {"diameter": 1.0, **entries[case["symmetries"]]}
        model = ModelErrors.from_models_info(vertices, entry, content["max_sym_disc_step"])
        assert len(model.symmetries) >= content["steps_of_a_continuous_symmetry"]
        poses = (matrix(case[f"R_{key}"], case[f"t_{key}"])[None] for key in ("est", "gt"))
        errors = model(*poses, camera)
        # Some of the errors are zero but for rounding.
        assert errors.mssd.item() == pytest.approx(case["mssd"], rel=1e-9, abs=1e-10)
        assert errors.mspd.item() == pytest.approx(case["mspd"], rel=1e-9, abs=1e-10)


def test_adi_is_what_a_tree_finds():
    vertices = body(subdivisions=4)
    T_est, T_true = pose_pairs(4)
    errors = {
        dtype: adi(T_est.to(dtype), T_true.to(dtype), vertices.to(dtype))
        for dtype in (torch.float64, torch.float32)
    }
    for i in range(4):
        ours, theirs = (reference.transform(T[i].numpy(), vertices.numpy()) for T in (T_est, T_true))
        wanted = cKDTree(ours).query(theirs)[0].mean()
        assert errors[torch.float64][i].item() == pytest.approx(wanted, rel=1e-12)
        assert errors[torch.float32][i].item() == pytest.approx(wanted, abs=1e-3)
        plain = reference.add(T_est[i].numpy(), T_true[i].numpy(), vertices.numpy())
        assert add(T_est, T_true, vertices)[i].item() == pytest.approx(plain, rel=1e-12)


def test_add_s_is_adi_for_symmetric_objects_only():
    pairs = pose_pairs(3)
    vertices = body(subdivisions=2)
    symmetric = ModelErrors.from_models_info(vertices, ENTRIES["discrete"])
    assert torch.equal(symmetric.add_s(*pairs), adi(*pairs, vertices))
    assert torch.equal(ModelErrors(vertices).add_s(*pairs), add(*pairs, vertices))
    assert not torch.allclose(adi(*pairs, vertices), add(*pairs, vertices), rtol=0.1)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), name=st.sampled_from(sorted(ENTRIES)))
def test_laws(seed, name):
    vertices = body(seed % 5, subdivisions=2)
    model = ModelErrors.from_models_info(vertices, ENTRIES[name], step=0.1)
    T_est, T_true = pose_pairs(5, seed)
    errors = model(T_est, T_true, K)
    generator = torch.Generator().manual_seed(seed)
    # Equivalent to the truth: no error.
    any_symmetry = torch.randint(len(model.symmetries), (5,), generator=generator)
    equivalent = model(T_true @ model.symmetries[any_symmetry], T_true, K)
    assert equivalent.mssd.max() < 1e-9
    assert equivalent.mspd.max() < 1e-9
    # Another equivalent truth: same errors, the symmetries being a group.
    again = model(T_est, T_true @ model.symmetries[any_symmetry], K)
    torch.testing.assert_close(again, errors, rtol=1e-8, atol=1e-8)
    # A motion of the whole scene does not change distances; a longer lens stretches the picture.
    T = se3_exp(
        torch.randn(1, 6, generator=generator, dtype=torch.float64) * torch.tensor([50, 50, 50, 1, 1, 1])
    )
    torch.testing.assert_close(model(T @ T_est, T @ T_true, K).mssd, errors.mssd, rtol=1e-9, atol=1e-9)
    lens = torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64).diag()
    torch.testing.assert_close(model(T_est, T_true, lens @ K).mspd, 2 * errors.mspd)
    # Bounds.
    plain = ModelErrors(vertices)(T_est, T_true, K)
    assert bool((errors.mssd <= plain.mssd + 1e-9).all())
    assert bool((errors.mspd <= plain.mspd + 1e-9).all())
    near, mean = adi(T_est, T_true, vertices), add(T_est, T_true, vertices)
    assert bool((near <= mean + 1e-9).all())
    assert bool((mean <= plain.mssd + 1e-9).all())


@pytest.mark.parametrize("name", ENTRIES)
def test_neighbours_and_chunks_do_not_matter(name, monkeypatch):
    vertices = vase(20, 24)
    model = ModelErrors.from_models_info(vertices, ENTRIES[name], step=0.05)
    T_est, T_true = pose_pairs(12)
    together = torch.stack([*model(T_est, T_true, K), model.add_s(T_est, T_true)])
    alone = [
        torch.stack(
            [*model(T_est[i, None], T_true[i, None], K), model.add_s(T_est[i, None], T_true[i, None])]
        )
        for i in range(12)
    ]
    torch.testing.assert_close(torch.cat(alone, dim=1), together, rtol=1e-12, atol=1e-12)
    for chunk_bytes in (1, 80_000, 10**9):
        monkeypatch.setattr("foundpose.bop.errors.working_bytes", lambda _, budget=chunk_bytes: budget)
        # One row at a time is slow for the nearest points.
        some = slice(0, 2) if chunk_bytes == 1 else slice(None)
        pairs = T_est[some], T_true[some]
        torch.testing.assert_close(
            torch.stack([*model(*pairs, K), model.add_s(*pairs)]), together[:, some], rtol=1e-12, atol=1e-12
        )
    nothing = model(T_est[:0], T_true[:0], K)
    assert nothing.mssd.shape == nothing.mspd.shape == model.add_s(T_est[:0], T_true[:0]).shape == (0,)


@pytest.mark.parametrize("name", ["none", "both"])
def test_poses_that_are_not_finite_have_infinite_errors(name):
    model = ModelErrors.from_models_info(body(subdivisions=2), ENTRIES[name], step=0.1)
    T_est, T_true = pose_pairs(5)
    good = torch.stack([*model(T_est, T_true, K), model.add_s(T_est, T_true)])
    T_est[1, 0, 3], T_true[2, 1, 1], T_est[4] = math.nan, math.inf, -math.inf
    T_est.requires_grad_()
    camera = K.clone().requires_grad_()
    errors = torch.stack([*model(T_est, T_true, camera), model.add_s(T_est, T_true)])
    assert bool((errors[:, [1, 2, 4]] == math.inf).all())
    torch.testing.assert_close(errors[:, [0, 3]], good[:, [0, 3]], rtol=1e-12, atol=1e-12)
    gradients = torch.autograd.grad(errors[:, [0, 3]].sum(), (T_est, camera))
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
    cameras = K.repeat(5, 1, 1)
    cameras[3, 0, 0] = math.nan
    errors = model(T_est, T_true, cameras)
    assert torch.isinf(errors.mspd).tolist() == [False, True, True, True, True]
    assert torch.isinf(errors.mssd).tolist() == [False, True, True, False, True]


@pytest.mark.parametrize("name", ["none", "both"])
def test_a_vertex_in_the_plane_of_the_camera(name):
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -10]], dtype=torch.float64)
    model = ModelErrors.from_models_info(vertices, ENTRIES[name], step=0.1)
    T = torch.eye(4, dtype=torch.float64)[None]
    T[0, 2, 3] = 10.0
    if name == "both":
        # Under the flip the last vertex is in front.
        T_est = T @ model.symmetries[len(model.symmetries) // 2]
        assert model(T_est, T_est, K).mspd.item() < 1e-9
    assert model(T, T + torch.tensor([0.1, 0, 0, 0]).diag(), K).mspd.item() == math.inf
    assert math.isfinite(model(T, T, K).mssd.item())


@pytest.mark.parametrize("name", ["none", "discrete"])
def test_gradients(name):
    vertices = body(subdivisions=0)
    model = ModelErrors.from_models_info(vertices, ENTRIES[name])
    T_est, T_true = pose_pairs(3)
    inputs = tuple(x.requires_grad_() for x in (T_est, T_true, K.clone(), vertices.clone()))
    functions = (
        lambda a, b, k, v: mssd(a, b, v, model.symmetries),
        lambda a, b, k, v: mspd(a, b, k, v, model.symmetries),
        lambda a, b, k, v: add(a, b, v),
        lambda a, b, k, v: adi(a, b, v),
    )
    for function in functions:
        assert torch.autograd.gradcheck(function, inputs)
    # At the truth the distance has no derivative; zero is one of its subgradients.
    exact = T_true.detach().clone().requires_grad_()
    for error in model(exact, T_true.detach(), K):
        assert torch.autograd.grad(error.sum(), exact)[0].abs().max() == 0


@pytest.mark.parametrize(
    "vertices",
    [
        [[1.0, 2, 3]],
        [[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [5, 5, 5]],
        [[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1], [0.4, 0.3, 1]],
    ],
    ids=["point", "line", "plate"],
)
def test_vertices_without_volume(vertices):
    model = ModelErrors(torch.tensor(vertices, dtype=torch.float64))
    assert torch.equal(model.hull, model.vertices)
    pairs = pose_pairs(5)
    np.testing.assert_allclose(model(*pairs, K).mssd, by_numpy(model, *pairs, K)[0], rtol=1e-11)


def test_hull_is_a_part_that_is_enough():
    inner = 0.8 * body(subdivisions=4)
    vertices = torch.cat([inner, body(subdivisions=4)])
    model = ModelErrors(vertices)
    assert 10 < len(model.hull) < len(vertices) / 2
    pairs = pose_pairs(50)
    torch.testing.assert_close(mssd(*pairs, model.hull), mssd(*pairs, vertices), rtol=1e-13, atol=0)


class LargestTensor(TorchDispatchMode):
    """Notes the bytes of the largest storage that an operation returns."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for value in out if isinstance(out, tuple | list) else [out]:
            if isinstance(value, torch.Tensor):
                self.bytes = max(self.bytes, value.untyped_storage().nbytes())
        return out


@pytest.mark.parametrize("chunk_bytes", [2**21, 2**23])
def test_memory_is_bounded(chunk_bytes, monkeypatch):
    monkeypatch.setattr("foundpose.bop.errors.working_bytes", lambda _: chunk_bytes)
    model = ModelErrors.from_models_info(body(subdivisions=4), ENTRIES["both"])
    assert len(model.symmetries) == 630
    pairs = pose_pairs(200)
    with LargestTensor() as largest:
        model(*pairs, K)
        adi(pairs[0][:2], pairs[1][:2], model.vertices)
    # All at once would be 200 × 630 × 3 × 2562 numbers.
    assert chunk_bytes / 4 < largest.bytes <= chunk_bytes


def best_of(repeats, *functions):
    """Shortest times of functions called in turn, on one thread; of this process, whatever else runs."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    times = np.full((repeats, len(functions)), np.inf)
    try:
        for row in times:
            for i, function in enumerate(functions):
                start = time.process_time()
                function()
                row[i] = time.process_time() - start
    finally:
        torch.set_num_threads(threads)
    return times.min(axis=0)


@pytest.mark.filterwarnings("ignore:mesh")
def test_five_times_faster_than_the_loop_on_a_submission(lmo_root):
    models, work = lmo_workload(lmo_root)
    loop, ours = best_of(
        3,
        lambda: [by_numpy(models[obj_id], *poses) for obj_id, (*poses, _) in work.items()],
        lambda: [models[obj_id](*poses) for obj_id, (*poses, _) in work.items()],
    )
    assert loop / ours > 5.0


def test_far_faster_than_the_loop_with_many_symmetries(blob):
    model = ModelErrors.from_models_info(blob.vertices.double(), ENTRIES["continuous"])
    pairs = pose_pairs(32)
    one = [x[:1] for x in pairs]
    loop, ours = best_of(3, lambda: by_numpy(model, *one, K), lambda: model(*pairs, K))
    assert loop / (ours / 32) > 30.0


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_devices_agree(device):
    if not getattr(torch, device).is_available():
        pytest.skip(f"no {device} device")
    model = ModelErrors.from_models_info(vase().float(), ENTRIES["both"])
    pairs = [x.float() for x in pose_pairs(50)]
    here = torch.stack([*model(*pairs, K.float()), model.add_s(*pairs)])
    model.to(device)
    pairs = [x.to(device) for x in pairs]
    there = torch.stack([*model(*pairs, K.float().to(device)), model.add_s(*pairs)])
    torch.testing.assert_close(there.cpu(), here, rtol=1e-4, atol=1e-3)


def test_bad_input_is_named():
    vertices = body(subdivisions=1)
    T = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    cases = [
        (lambda: mssd(T, T[:2], vertices), r"T_est and T_true must be \(B, 4, 4\)"),
        (lambda: mssd(T[0], T[0], vertices), r"T_est and T_true must be \(B, 4, 4\)"),
        (lambda: mssd(T.float(), T, vertices), "T_est must be torch.float64"),
        (lambda: add(T, T.float(), vertices), "T_true must be torch.float64"),
        (lambda: adi(T, T.to("meta"), vertices), "got torch.float64 on meta"),
        (lambda: mspd(T, T, K[0], vertices), r"K must be \(B, 3, 3\) or \(1, 3, 3\) with B = 3"),
        (lambda: mspd(T, T, K.repeat(2, 1, 1), vertices), r"got \(2, 3, 3\)"),
        (lambda: mspd(T, T, K.float(), vertices), "K must be torch.float64"),
        (lambda: mssd(T, T, vertices[:0]), "V at least 1"),
        (lambda: mssd(T, T, vertices[:, :2]), r"vertices must be \(V, 3\)"),
        (lambda: mssd(T, T, vertices.half()), "float32 or float64, got torch.float16"),
        (lambda: mssd(T, T, vertices, T[:0]), r"symmetries must be \(S, 4, 4\)"),
        (lambda: mssd(T, T, vertices, T.float()), "symmetries must be torch.float64"),
        (lambda: ModelErrors(vertices * math.nan), "must be finite"),
        (lambda: ModelErrors(vertices, T * math.inf), "must be finite"),
        (
            lambda: ModelErrors.from_models_info(vertices, {"size_x": 1.0}),
            r"diameter, got the keys \['size_x'\]",
        ),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()

import json
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from foundpose.geometry import (
    Symmetries,
    axis_rotation,
    discretise,
    make_transform,
    nearest_axis_angles,
    no_symmetries,
    stack_symmetries,
    symmetries_from_models_info,
    transform_points,
)

FLIP = [1, 0, 0, 4, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]
CONTINUOUS = {"axis": [1, 2, 2], "offset": [5.0, -3.0, 2.0]}
ENTRIES = {
    "none": {"diameter": 10.0},
    "discrete": {"symmetries_discrete": [FLIP]},
    "continuous": {"symmetries_continuous": [CONTINUOUS]},
    "both": {
        "symmetries_discrete": [FLIP],
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [1, 2, 0]}],
    },
    "two axes": {
        "symmetries_discrete": [FLIP],
        "symmetries_continuous": [CONTINUOUS, {"axis": [0, 0, 3], "offset": [0, 0, 0]}],
    },
}


def reference_set(entry, step):
    """BOP's set: continuous symmetries, sampled, after discrete ones; 4 x 4 matrices."""
    discrete = [
        np.eye(4),
        *(np.reshape(T, (4, 4)).astype(float) for T in entry.get("symmetries_discrete", [])),
    ]
    turns = []
    for axis in entry.get("symmetries_continuous", []):
        count = math.ceil(math.pi / step)
        direction = np.array(axis["axis"]) / np.linalg.norm(axis["axis"])
        for k in range(count):
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(direction * (2 * math.pi * k / count)).as_matrix()
            T[:3, 3] = -T[:3, :3] @ axis["offset"] + axis["offset"]
            turns.append(T)
    return np.stack([C @ D for D in discrete for C in (turns or [np.eye(4)])])


def same_set(a, b, tolerance=1e-12):
    distance = np.abs(a[:, None] - b[None]).max((2, 3))
    return distance.min(0).max() < tolerance and distance.min(1).max() < tolerance


@pytest.mark.parametrize("name", ENTRIES)
@pytest.mark.parametrize("step", [0.1, 0.7, 4.0])
def test_discretised_set_is_that_of_bop(name, step):
    T, valid = discretise(symmetries_from_models_info(ENTRIES[name]), step)
    wanted = reference_set(ENTRIES[name], step)
    assert same_set(T[valid].numpy(), wanted)
    if name != "two axes":
        assert valid.all()
        assert np.allclose(T[0].numpy(), wanted, atol=1e-12)


def test_padding_does_not_change_the_sets():
    single = [symmetries_from_models_info(entry) for entry in ENTRIES.values()]
    stacked = stack_symmetries(single)
    assert stacked.transforms.shape == (5, 2, 4, 4)
    assert stacked.axes.shape == (5, 2, 3)
    assert torch.allclose(torch.linalg.vector_norm(stacked.axes, dim=-1), torch.ones(5, 2).double())
    index = torch.tensor([4, 0, 0, 2, 3])
    T, valid = discretise(stacked.gather(index), 0.2)
    for i, k in enumerate(index.tolist()):
        alone, exists = discretise(single[k], 0.2)
        assert torch.equal(T[i][valid[i]], alone[exists])


def test_sets_equal_those_of_the_toolkit(lmo_root):
    path = lmo_root.parent / "bop_reference" / "symmetries.json"
    if not path.is_file():
        pytest.skip(f"no reference numbers at {path}")
    entries = json.loads(path.read_text())["entries"]
    assert len(entries) == 5
    for entry in entries:
        T, valid = discretise(symmetries_from_models_info(entry["model_info"]), 0.01)
        assert T.shape[1] == entry["count"]
        assert valid.all()
        for wanted in entry["transformations"]:
            got = T[0, wanted["index"]].numpy()
            assert np.allclose(got[:3, :3].ravel(), wanted["R"], atol=1e-12)
            assert np.allclose(got[:3, 3], wanted["t"], atol=1e-12)


def test_rotation_about_a_line(rng):
    axes = rng.normal(size=(6, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    origins, angles = rng.normal(size=(6, 3)) * 50, np.array([0.0, 1e-8, -0.3, 3.1, math.pi, 9.0])
    args = [torch.from_numpy(x) for x in (axes, origins, angles)]
    T = axis_rotation(*args).numpy()
    assert np.array_equal(T[0], np.eye(4))
    assert np.allclose(T[:, :3, :3], Rotation.from_rotvec(axes * angles[:, None]).as_matrix(), atol=1e-14)
    on_line = origins + 7.0 * axes
    assert np.allclose(np.einsum("bij,bj->bi", T[:, :3, :3], on_line) + T[:, :3, 3], on_line, atol=1e-12)
    small = axis_rotation(*(x.float() for x in args)).double().numpy()[1, :3, :3]
    assert np.allclose(small - np.eye(3), np.cross(np.eye(3), axes[1]) * 1e-8, atol=1e-14)
    assert torch.autograd.gradcheck(axis_rotation, tuple(x.requires_grad_() for x in args))


@pytest.mark.parametrize("scale", [1.0, 1.005])
def test_closed_form_angle_is_the_best_of_a_dense_sampling(rng, scale):
    batch, count, samples = 20, 40, 3600
    symmetries = symmetries_from_models_info(ENTRIES["two axes"]).gather(torch.zeros(batch, dtype=torch.long))
    points = torch.from_numpy(rng.normal(size=(batch, count, 3)) * 40 + 15)
    T_est, T_true = (
        make_transform(
            torch.from_numpy(Rotation.random(batch, random_state=seed).as_matrix()),
            torch.from_numpy(rng.normal(size=(batch, 3)) * 30 + [0, 0, 900]),
        )
        for seed in (1, 2)
    )
    T_true[:, :3, :3] *= scale
    mean = points.mean(1)
    covariance = (points - mean[:, None]).mT @ (points - mean[:, None]) / count
    angles = nearest_axis_angles(T_est, T_true, symmetries, mean, covariance)
    assert angles.shape == (batch, 2, 2)

    grid = torch.linspace(-math.pi, math.pi, samples, dtype=torch.float64).expand(batch, samples)
    for s in range(2):
        for a in range(2):
            tried = torch.cat([angles[:, s, a, None], grid], dim=1)
            C = axis_rotation(symmetries.axes[:, a, None], symmetries.origins[:, a, None], tried)
            S = C @ symmetries.transforms[:, s, None]
            displaced = transform_points(T_est[:, None] - T_true[:, None] @ S, points[:, None])
            error = displaced.square().sum(-1).mean(-1)
            assert (error[:, 0] <= error[:, 1:].amin(1) * (1 + 1e-12)).all()
            nearest = grid.gather(1, error[:, 1:].argmin(1, keepdim=True))[:, 0]
            apart = torch.remainder(nearest - angles[:, s, a] + math.pi, 2 * math.pi) - math.pi
            assert apart.abs().max() < 2 * math.pi / samples


def test_closed_form_angle_has_right_gradients(rng):
    symmetries = symmetries_from_models_info(ENTRIES["both"])
    R = torch.from_numpy(Rotation.random(2, random_state=3).as_matrix())
    T = make_transform(R, torch.from_numpy(rng.normal(size=(2, 3)))).split(1)
    root = torch.from_numpy(rng.normal(size=(1, 3, 3)))
    inputs = (*T, torch.from_numpy(rng.normal(size=(1, 3))), root @ root.mT)
    assert torch.autograd.gradcheck(
        lambda a, b, m, c: nearest_axis_angles(a, b, symmetries, m, c),
        tuple(x.requires_grad_() for x in inputs),
    )


def test_no_symmetries_is_the_identity_alone():
    symmetries = no_symmetries(3, dtype=torch.float64)
    symmetries.check(3, torch.zeros(1, dtype=torch.float64))
    T, valid = discretise(symmetries)
    assert torch.equal(T, torch.eye(4).double().expand(3, 1, 4, 4))
    assert valid.all()
    parsed = symmetries_from_models_info({})
    assert all(torch.equal(a[:1], b) for a, b in zip(symmetries, parsed, strict=True))
    assert symmetries.to(dtype=torch.float32).transforms.dtype == torch.float32
    assert symmetries.to(dtype=torch.float32).valid.dtype == torch.bool


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"symmetries_discrete": [FLIP[:12]]}, r"symmetries_discrete\[0\] must be 16 finite numbers"),
        (
            {"symmetries_discrete": [FLIP, [*FLIP[:3], math.nan, *FLIP[4:]]]},
            r"symmetries_discrete\[1\] must be 16",
        ),
        ({"symmetries_discrete": [["a"] * 16]}, "must be 16 numbers"),
        ({"symmetries_discrete": [np.diag([1.0, 1, -1, 1]).ravel().tolist()]}, "rigid transformation"),
        ({"symmetries_discrete": [np.diag([2.0, 2, 2, 1]).ravel().tolist()]}, "rigid transformation"),
        ({"symmetries_discrete": [np.reshape(FLIP, (4, 4)).T.ravel().tolist()]}, "row by row"),
        ({"symmetries_discrete": {"a": 1}}, "symmetries_discrete must be a list"),
        ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, r'symmetries_continuous\[0\] must be {"axis"'),
        ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}, "axis must not be zero"),
        (
            {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0]}]},
            "offset must be 3 finite numbers",
        ),
    ],
)
def test_bad_entries_are_refused(entry, message):
    with pytest.raises(ValueError, match=message):
        symmetries_from_models_info(entry)


def test_bad_arguments_are_refused():
    symmetries = no_symmetries(2)
    poses = torch.zeros(2, 4, 4)
    with pytest.raises(ValueError, match="at least one entry"):
        stack_symmetries([])
    with pytest.raises(ValueError, match="step must be positive"):
        discretise(symmetries, 0.0)
    with pytest.raises(ValueError, match="batch must not be negative"):
        no_symmetries(-1)
    for index in (torch.zeros(1, 1).long(), torch.zeros(2), torch.ones(2).bool()):
        with pytest.raises(ValueError, match="index must be"):
            symmetries.gather(index)
    with pytest.raises(ValueError, match=r"symmetries.transforms must have shape \(B, S, 4, 4\) with B = 3"):
        symmetries.check(3, poses)
    with pytest.raises(ValueError, match=r"symmetries.origins must have shape \(B, A, 3\)"):
        symmetries._replace(origins=torch.zeros(2, 1, 3)).check(2, poses)
    with pytest.raises(ValueError, match="S at least 1"):
        Symmetries(symmetries.transforms[:, :0], symmetries.valid[:, :0], *symmetries[2:]).check(2, poses)
    with pytest.raises(ValueError, match=r"must be torch\.float64 on cpu, got torch\.float32"):
        symmetries.check(2, poses.double())

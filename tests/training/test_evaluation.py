import math

import pytest
import torch

from foundpose.geometry import PerspectiveCrop, make_transform, symmetries_from_models_info
from foundpose.geometry.symmetries import axis_rotation
from foundpose.matching import PatchMatcher
from foundpose.pipeline import FoundPose, MatchAndSolve
from foundpose.pnp import RansacPnp
from foundpose.retrieval import QueryPatches, TemplateRetriever
from foundpose.synthetic import cluttered_scene
from foundpose.training import PoseErrors, compare, evaluate_scenes, summarize
from foundpose.training.adapter.evaluation import GivenTemplates, pose_errors


def turn(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_pose_errors_of_known_poses(bodies):
    mesh = bodies[0]
    truth = make_transform(torch.eye(3), torch.tensor([0.0, 0.0, 500.0])).expand(5, 4, 4)
    off = torch.tensor([0.0, 9.0, 11.0, 0.0, 0.0])
    shift = torch.tensor([0.0, 0.0, 0.0, 0.2, 0.0]) * float(mesh.diameter)
    estimates = torch.stack(
        [
            make_transform(turn(a), torch.tensor([float(d), 0.0, 500.0]))
            for a, d in zip(off, shift, strict=True)
        ]
    )
    errors = pose_errors(estimates, torch.tensor([True, True, True, True, False]), truth, mesh)
    assert errors.right.tolist() == [True, True, False, False, False]
    assert torch.allclose(errors.rotation, torch.tensor([0.0, 9.0, 11.0, 0.0, 180.0]), atol=0.05)
    assert torch.allclose(errors.lateral, torch.tensor([0.0, 0.0, 0.0, 0.2, torch.inf]), atol=1e-5)
    assert torch.allclose(errors.depth, torch.tensor([0.0, 0.0, 0.0, 0.0, torch.inf]), atol=1e-5)
    # A shift moves every point by itself; a turn by the chord at the mean distance from the axis.
    radius = mesh.vertices[:: len(mesh.vertices) // 1000, :2].norm(dim=1).mean() / mesh.diameter
    chord = 2 * math.sin(math.radians(4.5)) * radius
    wanted = torch.tensor([0.0, chord, 0.2, 1.0])
    assert torch.allclose(errors.matching[[0, 1, 3, 4]], wanted, atol=1e-4)


def test_pose_errors_of_symmetric_objects(bodies):
    mesh = bodies[0]
    axis, origin = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([5.0, -40.0, 20.0])
    symmetries = symmetries_from_models_info(
        {"symmetries_continuous": [{"axis": axis.tolist(), "offset": origin.tolist()}]}
    )
    truth = make_transform(turn(25.0), torch.tensor([3.0, 4.0, 500.0])).expand(3, 4, 4)
    angles = torch.tensor([0.0, 1.0, 2.5])
    tilt = make_transform(
        torch.tensor([[1.0, 0, 0], [0, 0.9848, -0.1736], [0, 0.1736, 0.9848]]), torch.tensor([0.0, 0.0, 0.0])
    )
    spun = truth @ axis_rotation(axis.expand(3, 3), origin.expand(3, 3), angles)
    found = torch.ones(3, dtype=torch.bool)
    errors = pose_errors(spun, found, truth, mesh, symmetries)
    assert errors.right.all()
    assert errors.rotation.max() < 0.1
    assert torch.hypot(errors.lateral, errors.depth).max() < 1e-3
    assert errors.matching.max() < 1e-3
    without = pose_errors(spun, found, truth, mesh)
    assert torch.allclose(without.rotation, torch.rad2deg(angles), atol=0.1)
    assert without.right.tolist() == [True, False, False]
    assert (torch.hypot(without.lateral, without.depth)[1:] > 0.05).all()
    # A tilt in the object's frame off the axis, after a spin: as far off as the tilt alone.
    errors = pose_errors(spun @ tilt, found, truth, mesh, symmetries)
    alone = pose_errors(truth @ tilt, found, truth, mesh, symmetries)
    for name in ("rotation", "lateral", "depth", "matching"):
        one, all_ = getattr(alone, name), getattr(errors, name)
        assert torch.allclose(one, all_, atol=2e-3 if name != "rotation" else 0.1), name
    assert 5.0 < alone.rotation[0] < 10.0


def errors_of(rotation, matching):
    nothing = torch.zeros(len(rotation))
    return PoseErrors(torch.tensor(rotation), nothing, nothing, torch.tensor(matching), nothing == 0)


def test_summary_and_paired_comparison():
    before = errors_of([1.0, 20.0, 30.0, 2.0], [0.1, 0.5, 0.9, 0.1])
    after = errors_of([1.0, 2.0, 3.0, 25.0], [0.1, 0.1, 0.2, 0.4])
    summary = summarize(after)
    assert summary["poses"] == 4
    assert summary["right"] == 0.75
    assert summary["right_standard_error"] == pytest.approx(math.sqrt(0.75 * 0.25 / 4))
    assert summary["mean_matching"] == pytest.approx(0.2)
    change = compare(before, after)
    assert (change["gained"], change["lost"]) == (2, 1)
    assert change["right"] == 0.25
    difference = [0.0, 1.0, 1.0, -1.0]
    deviation = math.sqrt(sum((d - 0.25) ** 2 for d in difference) / 4)
    assert change["right_standard_error"] == pytest.approx(deviation / 2)
    assert change["mean_matching"] == pytest.approx(-0.2)
    with pytest.raises(ValueError, match="4 and 1 poses"):
        compare(before, errors_of([1.0], [0.1]))


def test_scenes_with_retrieved_and_with_nearest_templates(bodies, sift_onboarder):
    mesh = bodies[1]
    representation = sift_onboarder(mesh, "body")
    pipeline = FoundPose(
        PerspectiveCrop(280),
        sift_onboarder.extractor,
        TemplateRetriever(sift_onboarder.bow, 2),
        MatchAndSolve(PatchMatcher(), RansacPnp(iterations=100)),
    ).train()
    pipeline.extractor.eval()
    modes = [part.training for part in pipeline.modules()]

    def scenes(*seeds):
        return (cluttered_scene(mesh, seed, renderer=sift_onboarder.renderer) for seed in seeds)

    sizes = []
    hook = pipeline.crop.register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    errors = evaluate_scenes(pipeline, representation, mesh, scenes(4, 7, 9), batch_size=2)
    hook.remove()
    assert sizes == [2, 2, 1, 1]
    # Measured in eval mode, the caller's modules are left in their own modes.
    assert [part.training for part in pipeline.modules()] == modes
    assert len(set(modes)) == 2
    alone = evaluate_scenes(pipeline, representation, mesh, scenes(9))
    for mode in ("retrieved", "nearest"):
        assert errors[mode].rotation.shape == (3,)
        assert torch.allclose(errors[mode].rotation[2:], alone[mode].rotation, atol=0.5)
    # Had the object the symmetry of a half turn, no error would be larger and some would be smaller.
    half_turn = {"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
    symmetries = symmetries_from_models_info(half_turn)
    forgiving = evaluate_scenes(pipeline, representation, mesh, scenes(4, 7, 9), symmetries=symmetries)
    for mode in ("retrieved", "nearest"):
        assert (forgiving[mode].rotation <= errors[mode].rotation + 0.5).all()
        assert (forgiving[mode].matching <= errors[mode].matching + 0.01).all()


def test_given_templates():
    given = GivenTemplates()
    valid = torch.tensor([[True, False], [False, False]])
    query = QueryPatches(torch.zeros(2, 2, 4), torch.zeros(2, 2, 2), valid)
    with pytest.raises(ValueError, match="given for 0 crops, there are 2"):
        given(query, None)
    given.index = torch.tensor([[5], [6]])
    found = given(query, None)
    assert found.index.tolist() == [[5], [6]]
    assert found.valid.tolist() == [[True], [False]]

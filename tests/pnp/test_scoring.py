"""Qualities of poses against NumPy, sampling on a bounded number of points, and where sampling stops."""

import math

import numpy as np
import pytest
import torch

from foundpose.pnp import PnpProblem, RansacPnp
from foundpose.pnp.sampling import Sampling, sample_hypotheses
from foundpose.pnp.scoring import score_poses
from tests.pnp.scenes import pose_errors, stack
from tests.pnp.test_ransac import random_scenes


def perturbed(scenes, count, scale):
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (len(scenes), count, 1, 1))
    T[..., :3, :3] = np.stack([s.R for s in scenes])[:, None]
    T[..., :3, 3] = np.stack([s.t for s in scenes])[:, None]
    T[..., :3, 3] += rng.normal(size=(*T.shape[:2], 3)) * scale
    T[:, 0, :3, 3] *= -1.0  # behind the camera
    return T


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quality_equals_a_loop_in_numpy(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = random_scenes(6, seed=12)
    image, model, K, valid = stack(scenes, dtype)
    poses = torch.from_numpy(perturbed(scenes, 40, 2.0)).to(dtype)
    quality = score_poses(poses, PnpProblem(image, model, K, valid), 10.0)
    for b in range(len(scenes)):
        n = valid[b]
        points = model[b][n].double().numpy()
        for s in range(poses.shape[1]):
            T = poses[b, s].double().numpy()
            camera = points @ T[:3, :3].T + T[:3, 3]
            pixels = (camera / camera[:, 2:]) @ K[b].double().numpy().T[:, :2]
            squared = ((pixels - image[b][n].double().numpy()) ** 2).sum(1)
            inlier = (squared <= 100.0) & (camera[:, 2] > 0)
            expected = inlier.sum() + 0.5 * (1.0 - squared[inlier].sum() / max(inlier.sum(), 1) / 100.0)
            assert quality[b, s].item() == pytest.approx(
                expected, abs=2e-3 if dtype == torch.float32 else 1e-9
            )
    assert (quality[:, 0] == 0.5).all()
    assert quality.max() > 20
    # Blocks are for speed only.
    monkeypatch.setattr("foundpose.pnp.scoring._CPU_NUMBERS_PER_BLOCK", 7 * valid.numel())
    assert torch.equal(score_poses(poses, PnpProblem(image, model, K, valid), 10.0), quality)


def test_numbers_that_overflow_are_no_inliers() -> None:
    image, model = torch.zeros(1, 5, 2), torch.zeros(1, 5, 3)
    model[0, 0] = 1e9
    T = torch.eye(4).repeat(1, 3, 1, 1)
    T[0, :, 2, 3] = torch.tensor([0.0, 1e30, 1.0])
    K = torch.eye(3)[None] * torch.tensor([1e12, 1e12, 1.0])
    quality = score_poses(T, PnpProblem(image, model, K), 10.0)
    assert torch.isfinite(quality).all()
    assert quality[0].floor().tolist() == [0.0, 4.0, 4.0]


def test_few_points_score_as_well() -> None:
    scenes = random_scenes(60, seed=8)
    inputs = stack(scenes, torch.float32)
    shares = []
    for score_points in (None, 40):
        result = RansacPnp(score_points=score_points)(PnpProblem(*inputs))
        rotation, translation = pose_errors(result.T_camera_from_model, scenes)
        shares.append(((rotation < 5.0) & (translation < 0.05)).mean())
        # What is returned is about all correspondences.
        assert (result.inliers & ~inputs[3]).sum() == 0
        assert result.num_inliers.max() > 40
    assert shares[1] > shares[0] - 0.05
    # A bound that does not bind changes nothing.
    loose, none = (RansacPnp(score_points=bound)(PnpProblem(*inputs)) for bound in (10_000, None))
    assert torch.equal(loose.T_camera_from_model, none.T_camera_from_model)


def test_sampling_stops_as_the_usual_bound_says() -> None:
    """Against the rule applied to one sample after another."""
    scenes = random_scenes(12, seed=21)
    image, model, K, valid = stack(scenes, torch.float64)
    draws = torch.randint(2**31, (300, 4), generator=torch.Generator().manual_seed(0))
    each = Sampling("p3p", threshold=10.0)
    usable = torch.ones(len(scenes), dtype=torch.bool)
    problem = PnpProblem(image, model, K, valid)
    stopped = sample_hypotheses(problem, usable, draws, each._replace(confidence=0.99))
    after = []
    for b, scene in enumerate(scenes):
        one = problem.take(torch.tensor([b]))
        count, best, number = len(scene.points_model), -1.0, 0
        while number < 300:
            number += 1
            last = sample_hypotheses(one, usable[:1], draws[number - 1 : number], each).quality.item()
            best = max(best, last)
            ratio = min(math.floor(max(best, 0.0)) / count, 1 - 1e-6)
            if number >= 50 and number * math.log1p(-(ratio**4)) <= math.log(0.01):
                break
        assert stopped.quality[b, 0].item() == pytest.approx(best, abs=1e-9)
        after.append(number)
    assert min(after) == 50
    assert max(after) > 60

"""kornia's direct linear transform as a minimal solver."""

import numpy as np
import pytest
import torch
from kornia.geometry import solve_pnp_dlt

from foundpose.geometry.cameras import pixel_rays
from foundpose.pnp import PnpProblem, PnpStatus, RansacPnp
from foundpose.pnp.dlt import solve_dlt_minimal
from tests.pnp.scenes import make_scene, pose_errors, stack


def samples(shape="volume", count=40, size=6):
    rng = np.random.default_rng(0)
    scenes = [make_scene(rng, size, shape, wide=True) for _ in range(count)]
    image, model, K, _ = stack(scenes, torch.float64)
    return scenes, image, model, K


def test_it_is_kornias_and_gives_the_true_pose():
    scenes, image, model, K = samples()
    found = solve_dlt_minimal(pixel_rays(image, K), model)
    assert found.valid.all()
    assert not found.degenerate.any()
    torch.testing.assert_close(
        found.T_camera_from_model[:, :3], solve_pnp_dlt(model, image, K), atol=1e-5, rtol=1e-6
    )
    angle, distance = pose_errors(found.T_camera_from_model, scenes)
    assert angle.max() < 1e-4
    assert distance.max() < 1e-6


def test_flat_samples_are_degenerate_and_spoil_no_other():
    _, image, model, K = samples()
    alone = solve_dlt_minimal(pixel_rays(image, K), model)
    model = model.clone()
    model[3, :, 2] = 0.0  # a plane
    model[4] = model[4, :1]  # one point
    image[5] = image[5, :1]  # one pixel
    found = solve_dlt_minimal(pixel_rays(image, K), model)
    assert found.degenerate.nonzero().flatten().tolist() == [3, 4, 5]
    assert not found.valid[3:6].any()
    assert torch.equal(found.T_camera_from_model[3], torch.eye(4, dtype=torch.float64))
    others = torch.ones(len(model), dtype=torch.bool)
    others[3:6] = False
    assert torch.equal(found.T_camera_from_model[others], alone.T_camera_from_model[others])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_in_ransac(dtype):
    rng = np.random.default_rng(1)
    scenes = []
    for _ in range(24):
        scene = make_scene(rng, 80, "ellipsoid")
        image = scene.points_image + rng.normal(0.0, 1.0, scene.points_image.shape)
        outliers = rng.permutation(80)[:24]
        image[outliers] = rng.uniform(0.0, 420.0, (24, 2))
        scenes.append(scene._replace(points_image=image))
    result = RansacPnp("dlt")(PnpProblem(*stack(scenes, dtype)))
    angle, distance = pose_errors(result.T_camera_from_model, scenes)
    assert result.success.all()
    assert ((angle < 5.0) & (distance < 0.05)).mean() >= 0.9


def test_too_few_and_flat():
    rng = np.random.default_rng(2)
    few, flat = make_scene(rng, 5), make_scene(rng, 40, "plane")
    result = RansacPnp("dlt", mirror=False)(PnpProblem(*stack([few, flat], torch.float64)))
    assert result.status.tolist() == [PnpStatus.TOO_FEW_CORRESPONDENCES, PnpStatus.DEGENERATE]
    with pytest.raises(ValueError, match="min_inliers must be at least 6, got 4"):
        RansacPnp("dlt", min_inliers=4)

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from foundpose.geometry import make_transform, project_points, transform_points
from foundpose.refinement import apply_update, rotation_from_6d, rotation_to_6d, update_between
from foundpose.refinement.pose_update import IDENTITY_UPDATE

K = torch.tensor([[300.0, 0.0, 31.5], [0.0, 280.0, 31.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
CENTRE = torch.tensor([7.0, -3.0, 11.0], dtype=torch.float64)


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())
    t = torch.from_numpy(rng.uniform([-40, -40, 250], [40, 40, 500], (count, 3)))
    return make_transform(R, t)


def test_identity_leaves_poses_as_they_are():
    T = poses(20)
    update = torch.tensor(IDENTITY_UPDATE, dtype=torch.float64)
    torch.testing.assert_close(apply_update(T, update, K, CENTRE), T, rtol=0, atol=1e-12)


def test_update_against_the_papers_formula():
    """CosyPose, equations of its supplement, written out for one pose."""
    T = poses(1)[0]
    turn = Rotation.from_euler("xyz", [20.0, -35.0, 50.0], degrees=True).as_matrix()
    vx, vy, vz = 4.0, -2.5, 1.2
    update = torch.tensor([vx, vy, vz, *turn[:, 0], *turn[:, 1]], dtype=torch.float64)
    moved = apply_update(T, update, K, CENTRE).numpy()
    x, y, z = T.numpy()[:3, :3] @ CENTRE.numpy() + T.numpy()[:3, 3]
    after = moved[:3, :3] @ CENTRE.numpy() + moved[:3, 3]
    depth = vz * z
    np.testing.assert_allclose(after, [(vx / 300 + x / z) * depth, (vy / 280 + y / z) * depth, depth])
    np.testing.assert_allclose(moved[:3, :3], turn @ T.numpy()[:3, :3], atol=1e-12)
    # In the picture the centre moves by vx, vy pixels, whatever else happens.
    pixel = [project_points(transform_points(A, CENTRE[None]), K)[0][0] for A in (T, torch.from_numpy(moved))]
    np.testing.assert_allclose((pixel[1] - pixel[0]).numpy(), [vx, vy], atol=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 40.0, 180.0])
def test_known_motion_is_recovered(degrees):
    before = poses(30, seed=1)
    axis = torch.nn.functional.normalize(
        torch.from_numpy(np.random.default_rng(2).normal(size=(30, 3))), dim=1
    )
    turn = torch.from_numpy(Rotation.from_rotvec((axis * math.radians(degrees)).numpy()).as_matrix())
    after = make_transform(turn @ before[:, :3, :3], poses(30, seed=3)[:, :3, 3])
    update = update_between(before, after, K, CENTRE)
    torch.testing.assert_close(apply_update(before, update, K, CENTRE), after, rtol=0, atol=1e-9)
    single = apply_update(before.float(), update.float(), K.float(), CENTRE.float())
    torch.testing.assert_close(single.double(), after, rtol=1e-5, atol=1e-3)


def test_rotations_from_columns():
    rng = np.random.default_rng(0)
    R = torch.from_numpy(Rotation.random(50, random_state=1).as_matrix())
    torch.testing.assert_close(rotation_from_6d(rotation_to_6d(R)), R)
    # Any two columns: the QR decomposition with a positive diagonal.
    columns = rng.normal(size=(50, 3, 2))
    q, r = np.linalg.qr(columns)
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    found = rotation_from_6d(torch.from_numpy(columns.transpose(0, 2, 1).reshape(50, 6)))
    np.testing.assert_allclose(found[..., :2].numpy(), q, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(50, dtype=torch.float64))
    for degenerate in ([0.0] * 6, [1.0, 2.0, 3.0, 2.0, 4.0, 6.0]):
        assert torch.linalg.det(rotation_from_6d(torch.tensor(degenerate))).abs() < 1e-3


def test_gradcheck():
    T = poses(3, seed=4)
    generator = torch.Generator().manual_seed(0)
    update = torch.tensor(IDENTITY_UPDATE, dtype=torch.float64).repeat(3, 1)
    update = update + 0.2 * torch.randn(3, 9, generator=generator, dtype=torch.float64)
    arguments = [x.clone().requires_grad_() for x in (T, update, CENTRE.expand(3, 3))]
    assert torch.autograd.gradcheck(lambda T, u, c: apply_update(T, u, K, c), arguments)
    assert torch.autograd.gradcheck(
        lambda T, c: update_between(T, poses(3, seed=5), K, c), (arguments[0], arguments[2])
    )

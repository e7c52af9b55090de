import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from foundpose.geometry import (
    axis_rotation_to_ray,
    invert_transform,
    make_transform,
    pixel_rays,
    project_points,
    project_to_rotation,
    rotation_angle,
    se3_exp,
    transform_points,
    unproject_pixels,
)


def random_transforms(count):
    R = torch.from_numpy(Rotation.random(count, random_state=0).as_matrix())
    return make_transform(R, torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).double())


def test_exponential_map_equals_the_matrix_exponential(rng):
    for scale in (0.0, 1e-9, 1e-4, 0.3, 3.1, 7.0):
        twist = rng.normal(size=6) * scale
        v, w = twist[:3], twist[3:]
        generator = torch.tensor(
            [[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]]
        ).numpy()
        assert torch.allclose(se3_exp(torch.from_numpy(twist)), torch.from_numpy(expm(generator)), atol=1e-10)


def test_exponential_map_is_differentiable_at_the_identity():
    for twist in (torch.zeros(2, 6), torch.full((2, 6), 0.4)):
        assert torch.autograd.gradcheck(se3_exp, (twist.double().requires_grad_(),))
        assert not se3_exp(twist).requires_grad


def test_inverse_and_composition():
    T = random_transforms(5)
    points = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.allclose(transform_points(invert_transform(T), transform_points(T, points)), points)
    assert torch.allclose(
        invert_transform(T) @ T, torch.eye(4, dtype=torch.float64).expand(5, 4, 4), atol=1e-12
    )
    with pytest.raises(ValueError, match="R and t must end in"):
        make_transform(torch.eye(4), torch.zeros(3))
    with pytest.raises(ValueError, match="twist must have shape"):
        se3_exp(torch.zeros(5))


def test_rotation_angle_is_accurate_from_zero_to_pi(rng):
    axis = rng.normal(size=3)
    axis /= (axis**2).sum() ** 0.5
    base = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    for angle in (0.0, 1e-7, 0.5, 3.0, 3.1415926):
        R = base @ torch.from_numpy(Rotation.from_rotvec(axis * angle).as_matrix())
        assert rotation_angle(base, R).item() == pytest.approx(angle, abs=1e-9)


def test_nearest_rotation():
    R = random_transforms(4)[:, :3, :3]
    assert torch.allclose(project_to_rotation(1.005 * R), R, atol=1e-12)
    reflected = project_to_rotation(-R)
    assert torch.allclose(torch.det(reflected), torch.ones(4, dtype=torch.float64))


def test_project_and_unproject_round_trip(generator):
    K = torch.tensor([[500.0, 1.5, 300.0], [0.0, 510.0, 250.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pixels = torch.rand(100, 2, generator=generator, dtype=torch.float64) * 600
    depth = 0.1 + torch.rand(100, generator=generator, dtype=torch.float64) * 1000
    again, z = project_points(unproject_pixels(pixels, depth, K), K)
    assert torch.allclose(again, pixels)
    assert torch.allclose(z, depth)
    flat, z = project_points(torch.tensor([[1.0, 2.0, 0.0], [1.0, 2.0, -3.0]], dtype=torch.float64), K)
    assert torch.isfinite(flat).all()
    assert (z <= 0).all()


def test_rotation_onto_a_ray_is_the_smallest():
    pixels = torch.tensor([[0.0, 0.0], [300.0, 250.0], [640.0, 10.0]], dtype=torch.float64)
    K = torch.tensor([[500.0, 0.0, 300.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rays = pixel_rays(pixels, K)
    R = axis_rotation_to_ray(rays)
    turned = (R @ rays.unsqueeze(-1)).squeeze(-1)
    assert turned[:, :2].abs().max() < 1e-12
    to_axis = torch.atan2(rays[:, :2].norm(dim=1), rays[:, 2])
    assert torch.allclose(rotation_angle(torch.eye(3, dtype=torch.float64).expand(3, 3, 3), R), to_axis)

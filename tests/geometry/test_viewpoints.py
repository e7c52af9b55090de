import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from foundpose.geometry import rotation_angle, sphere_inplane_rotations, super_fibonacci_rotations


def nearest_angles(R_from: torch.Tensor, R_to: torch.Tensor, skip_self: bool) -> torch.Tensor:
    cosine = (R_from.reshape(-1, 9) @ R_to.reshape(-1, 9).T - 1) / 2
    if skip_self:
        cosine.fill_diagonal_(-1)
    return torch.rad2deg(torch.arccos(cosine.amax(1).clamp(-1, 1)))


@pytest.mark.parametrize("rotations", [super_fibonacci_rotations(500), sphere_inplane_rotations(31, 12)])
def test_rotations_are_proper(rotations):
    identity = torch.eye(3, dtype=torch.float64)
    assert (rotations @ rotations.transpose(1, 2) - identity).abs().max() < 1e-12
    assert (torch.det(rotations) - 1).abs().max() < 1e-12


def test_super_fibonacci_covers_the_group_evenly():
    rotations = super_fibonacci_rotations(800)
    neighbours = nearest_angles(rotations, rotations, skip_self=True)
    assert neighbours.mean() == pytest.approx(24.7, abs=0.5)
    assert neighbours.std() < 0.1 * neighbours.mean()
    queries = torch.from_numpy(Rotation.random(4000, random_state=0).as_matrix())
    gap = nearest_angles(queries, super_fibonacci_rotations(800), skip_self=False)
    assert gap.mean() < 13.0
    assert gap.max() < 25.0
    random = torch.from_numpy(Rotation.random(800, random_state=1).as_matrix())
    for count in (400, 1600):
        other = nearest_angles(queries, super_fibonacci_rotations(count), skip_self=False)
        # The volume of SO(3) ties the spacing to the count.
        assert other.mean() == pytest.approx(gap.mean().item() * (800 / count) ** (1 / 3), rel=0.03)
    assert gap.max() < 0.75 * nearest_angles(queries, random, skip_self=False).max()


def test_sphere_inplane_spacing():
    rotations = sphere_inplane_rotations(57, 14)
    assert rotations.shape == (798, 3, 3)
    # Neighbours in the plane are 360 / 14 degrees apart, those of other views about as far.
    first = rotation_angle(rotations[0], rotations[1])
    assert torch.rad2deg(first) == pytest.approx(360 / 14, abs=1e-6)
    neighbours = nearest_angles(rotations, rotations, skip_self=True)
    assert 20 < neighbours.min() <= neighbours.max() < 26
    # In-plane rotations of a view share its viewing direction.
    directions = rotations[:, 2].reshape(57, 14, 3)
    assert (directions - directions[:, :1]).abs().max() < 1e-12
    assert np.linalg.norm(directions[:, 0].mean(0)) < 0.02


@pytest.mark.parametrize(
    "call", [lambda: super_fibonacci_rotations(0), lambda: sphere_inplane_rotations(5, 0)]
)
def test_bad_counts(call):
    with pytest.raises(ValueError, match="at least 1, got"):
        call()

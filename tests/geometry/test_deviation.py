import torch

from foundpose.geometry import make_transform, perturbed_poses, pose_deviation, se3_exp


def test_deviations_and_perturbations():
    generator = torch.Generator().manual_seed(0)
    T = make_transform(torch.eye(3), torch.tensor([-20.0, 5.0, 700.0])).expand(200, 4, 4)
    degrees, distance = torch.linspace(0.5, 15, 200), torch.linspace(1, 20, 200)
    moved = perturbed_poses(T, degrees, distance, generator)
    found = pose_deviation(moved, T, unit=100.0)
    torch.testing.assert_close(found.rotation, degrees, atol=1e-2, rtol=0)
    whole = (found.lateral.square() + found.depth.square()).sqrt()
    torch.testing.assert_close(whole, distance / 100, atol=1e-4, rtol=0)
    assert not found.converged()[50:].any()
    assert pose_deviation(T, T, 100.0).converged().all()
    # Directions are spread evenly: a third of the squared length lies along the sight.
    assert abs((found.depth.square() / whole.square()).mean() - 1 / 3) < 0.08


def test_the_deviation_of_a_point_of_the_model():
    """A turn about a point leaves it where it is, and moves the origin."""
    T = make_transform(torch.eye(3), torch.tensor([30.0, -20.0, 500.0])).double()
    turn = se3_exp(torch.tensor([0.0, 0, 0, 0.1, -0.2, 0.05]).double())
    centre = torch.tensor([5.0, 40.0, -10.0]).double()
    there, back = (make_transform(torch.eye(3).double(), x) for x in (centre, -centre))
    turned = T @ there @ turn @ back
    assert pose_deviation(turned, T, 2.0, centre).translation < 1e-12
    moved = turn[:3, :3] @ centre - centre
    torch.testing.assert_close(pose_deviation(turned, T, 2.0).translation, moved.norm() / 2.0)

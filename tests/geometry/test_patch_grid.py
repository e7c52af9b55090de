import torch
import torch.nn.functional as F

from foundpose.geometry import PatchGrid


def test_patches_of_a_picture():
    grid = PatchGrid.of_picture(14.0, 6.5, 420)
    assert grid == (14.0, 6.5, 30)
    # Outer patches are as far from one end as from the other: 6.5 px from pixel 0 and from pixel 419.
    centers = grid.centers(torch.device("cpu"), torch.float64)
    assert centers.shape == (30, 30, 2)
    assert centers[0, 0].tolist() == [6.5, 6.5]
    assert centers[2, 29].tolist() == [412.5, 34.5]
    assert PatchGrid.of_picture(7.0, 3.0, 420).size == 60
    assert PatchGrid.of_picture(14.0, 6.5, 13).size == 0


def test_there_and_back():
    grid = PatchGrid(7.0, 3.0, 5)
    cells = torch.arange(25)
    pixels = grid.pixels_of(cells, torch.float64)
    assert torch.equal(pixels, grid.centers(torch.device("cpu"), torch.float64).reshape(-1, 2))
    assert torch.equal(grid.to_map(pixels), torch.stack([cells % 5, cells // 5], dim=-1).double())


def test_samples_are_means_of_the_pixels_around_a_centre():
    picture = torch.rand(2, 3, 420, 420, dtype=torch.float64)
    grid = PatchGrid.of_picture(14.0, 6.5, 420)
    # Centres lie between four pixels.
    expected = F.avg_pool2d(picture[:, :, 6:, 6:], 2, stride=14)
    torch.testing.assert_close(grid.sample(picture), expected)

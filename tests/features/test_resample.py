import pytest
import torch
from torch import Tensor

from foundpose.features.resample import on_grid, resize_images, sample_cells


def ramp(m: int, stride: float, offset: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """(1, 2, m, m): the pixel coordinates of the cells of a map."""
    axis = torch.arange(m, dtype=dtype) * stride + offset
    u, v = torch.meshgrid(axis, axis, indexing="xy")
    return torch.stack([u, v])[None]


@pytest.mark.parametrize(("m", "n"), [(64, 30), (30, 30), (120, 30), (53, 30), (8, 4)])
def test_cells_that_tile_the_image_are_read_at_the_patch_centres(m: int, n: int) -> None:
    size = 14 * n
    stride = size / m
    found = on_grid(ramp(m, stride, (stride - 1) / 2), n)
    torch.testing.assert_close(found, ramp(n, 14, 6.5), atol=1e-9, rtol=0)


def test_a_coarser_map_is_repeated_beyond_its_outermost_cells() -> None:
    """Cells of 28 px: the first patch lies before the first cell's centre, 13.5."""
    found = on_grid(ramp(2, 28, 13.5), 4)[0, 0, 0]
    torch.testing.assert_close(found, torch.tensor([13.5, 20.5, 34.5, 41.5]).double())


def test_cells_with_an_offset_of_their_own() -> None:
    """The map of a network whose cell k lies on pixel 8 k."""
    points = ramp(30, 14, 6.5)[0].permute(1, 2, 0)
    found = sample_cells(ramp(53, 8, 0), points, 8, 0)
    torch.testing.assert_close(found, ramp(30, 14, 6.5), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("old", "new"), [(420, 480), (420, 1024), (420, 210), (420, 420)])
def test_resized_ramp(old: int, new: int) -> None:
    """A point at u goes to (u + 0.5) new / old - 0.5."""
    found = resize_images(ramp(old, 1, 0), new)
    inner = slice(4, -4)
    expected = ramp(new, old / new, (old / new - 1) / 2)
    torch.testing.assert_close(found[..., inner, inner], expected[..., inner, inner], atol=1e-9, rtol=0)


def test_shrinking_is_antialiased() -> None:
    stripes = (torch.arange(64) % 2).double().expand(1, 1, 64, 64)
    assert (resize_images(stripes, 16)[..., 2:-2] - 0.5).abs().max() < 0.05


def test_gradcheck() -> None:
    g = torch.Generator().manual_seed(0)
    features = torch.randn(2, 3, 5, 5, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: on_grid(x, 3), features)
    points = (torch.rand(2, 2, 2, generator=g, dtype=torch.float64) * 10 + 10).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, p: sample_cells(x, p, 8.0, 0.0), (features, points))

"""Growing and shrinking of masks."""

import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from foundpose.geometry import grow_masks


@pytest.mark.parametrize("radius", [0, 1, 2, 7, 40])
def test_masks_grow_and_shrink_by_squares(radius, generator):
    few = torch.rand(2, 3, 30, 41, generator=generator) > 0.98
    grown, shrunk = grow_masks(few, radius), grow_masks(~few, -radius)
    square = torch.ones(1, 1, 2 * radius + 1, 2 * radius + 1, dtype=torch.bool).numpy()
    assert torch.equal(grown, torch.from_numpy(binary_dilation(few.numpy(), square)))
    assert torch.equal(shrunk, torch.from_numpy(binary_erosion((~few).numpy(), square, border_value=1)))

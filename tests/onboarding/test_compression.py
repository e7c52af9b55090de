import numpy as np
import pytest
import torch

from foundpose.geometry import SuperFibonacci
from foundpose.onboarding import template_cameras
from foundpose.onboarding.compression import (
    dequantize,
    join_pictures,
    pack_pictures,
    quantize,
    unpack_pictures,
)
from foundpose.rendering import CoordinateRenderer, RaycastRenderer


def same(packed, rows, levels, masks, bits):
    found = unpack_pictures(packed, rows, levels.shape[-2:], bits)
    return torch.equal(found[0], levels[rows]) and torch.equal(found[1], masks[rows])


@pytest.mark.parametrize("renderer", [RaycastRenderer(), CoordinateRenderer()])
def test_rendered_templates_come_back_bit_for_bit_and_take_less_space(blob, renderer):
    cameras = template_cameras(blob, SuperFibonacci(6)().float(), 420, 0.6, 6.0)
    render = renderer(blob, *cameras, (420, 420))
    levels = quantize(render.rgb, renderer.bits)
    packed = pack_pictures(levels, render.mask, renderer.bits)
    for rows in (slice(None), slice(2, 5), slice(5, 9), slice(3, 3)):
        assert same(packed, rows, levels, render.mask, renderer.bits)
    # The object's box takes 36 % of the picture.
    assert len(packed.streams) < 0.25 * levels.numel() * renderer.bits / 8
    halves = [pack_pictures(levels[s], render.mask[s], renderer.bits) for s in (slice(0, 2), slice(2, 6))]
    joined = join_pictures(halves)
    assert all(torch.equal(a, b) for a, b in zip(joined, packed, strict=True))


@pytest.mark.parametrize("bits", [8, 16])
def test_any_content_comes_back(bits, rng):
    levels = torch.from_numpy(rng.integers(0, 2**bits, (5, 3, 13, 11), dtype=np.int32))
    masks = torch.from_numpy(rng.random((5, 13, 11)) < 0.5)
    levels[1], masks[1] = 0, False  # nothing to be seen
    levels[2], masks[2] = 0, False
    masks[2, 7, 3] = True  # a black pixel on the object
    masks[3] = False  # colours beside the mask, up to the border
    levels[4, :, 1:, :], levels[4, :, :, 1:] = 0, 0
    levels[4, :, 0, 0], masks[4] = 2**bits - 1, False
    packed = pack_pictures(levels, masks, bits)
    assert same(packed, slice(None), levels, masks, bits)


@pytest.mark.parametrize("bits", [8, 16])
def test_every_integer_survives_the_way_to_a_colour_and_back(bits):
    levels = torch.arange(2**bits, dtype=torch.int32)
    colours = dequantize(levels, bits)
    assert colours.dtype == torch.float32
    assert colours[0] == 0.0
    assert colours[-1] == 1.0
    assert torch.equal(quantize(colours, bits), levels)
    anything = torch.linspace(0, 1, 99991)
    error = (dequantize(quantize(anything, bits), bits) - anything).abs().max()
    assert error <= 0.5 / (2**bits - 1) + 1e-7  # float32

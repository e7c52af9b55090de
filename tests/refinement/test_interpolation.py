import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.refinement import sample_features
from foundpose.refinement.interpolation import bagged_rows, gathered_rows


def maps(seed: int = 0, m: int = 2, h: int = 6, w: int = 8, d: int = 3) -> Tensor:
    return torch.randn(m, h, w, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def positions(n: int = 4, P: int = 20, low: float = -2.0, high: float = 9.0) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return low + (high - low) * torch.rand(n, P, 2, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("h", [6, 8])
def test_bilinear_values_equal_grid_sample(h: int) -> None:
    features, index, position = maps(h=h), torch.tensor([0, 1, 1, 0]), positions()
    got = sample_features(features, index, position)[..., 0, :]
    size = torch.tensor([8, h], dtype=torch.float64)
    grid = (2 * position + 1) / size - 1
    expected = F.grid_sample(
        features.permute(0, 3, 1, 2)[index],
        grid[:, None],
        padding_mode="border",
        align_corners=False,
    )
    torch.testing.assert_close(got, expected[:, :, 0].transpose(1, 2))


def test_bicubic_values_equal_keys_kernel() -> None:
    """Keys, 1981: u(s) for a = -1/2, on one channel, cell by cell."""

    def u(s: float) -> float:
        s = abs(s)
        if s < 1:
            return 1.5 * s**3 - 2.5 * s**2 + 1
        return -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2 if s < 2 else 0.0

    features, position = maps(), positions(1, 30, 0.0, 5.0)
    got = sample_features(features, torch.tensor([1]), position, "bicubic")[0, :, 0, 2]
    for (x, y), value in zip(position[0].tolist(), got.tolist(), strict=True):
        expected = sum(
            u(x - c) * u(y - r) * features[1, min(max(r, 0), 5), min(max(c, 0), 7), 2].item()
            for r in range(-2, 8)
            for c in range(-2, 10)
        )
        assert value == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_derivatives_against_autograd(interpolation: str) -> None:
    features, index = maps(), torch.tensor([0, 1, 1, 0])
    position = positions().requires_grad_()
    sampled = sample_features(features, index, position, interpolation)
    for channel in range(3):
        (gradient,) = torch.autograd.grad(sampled[..., 0, channel].sum(), position, retain_graph=True)
        torch.testing.assert_close(gradient[..., 0], sampled[..., 1, channel].detach())
        torch.testing.assert_close(gradient[..., 1], sampled[..., 2, channel].detach())
    outside = position[..., 0] < 0
    assert outside.any()
    assert (sampled[..., 1, :][outside] == 0).all()


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_gradcheck(interpolation: str) -> None:
    features = maps(h=4, w=5, d=2).requires_grad_()
    position = positions(2, 3, 0.2, 3.0).requires_grad_()
    index = torch.tensor([1, 0])
    assert torch.autograd.gradcheck(
        lambda f, p: sample_features(f, index, p, interpolation), (features, position), atol=1e-6
    )


def test_bicubic_slopes_are_continuous_and_linear_maps_are_exact() -> None:
    features, index = maps(), torch.tensor([0])
    just = torch.tensor([[[3.0 - 1e-9, 2.3], [3.0 + 1e-9, 2.3]]], dtype=torch.float64)
    left, right = sample_features(features, index, just, "bicubic")[0]
    torch.testing.assert_close(left, right, atol=1e-7, rtol=0)
    bilinear = sample_features(features, index, just, "bilinear")[0]
    assert (bilinear[0, 1] - bilinear[1, 1]).abs().max() > 0.1
    row, column = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    ramp = torch.stack([2 * column - row, row], dim=-1)[None].double()
    inner = positions(1, 20, 1.0, 4.0)
    for interpolation in ("bilinear", "bicubic"):
        got = sample_features(ramp, index, inner, interpolation)
        torch.testing.assert_close(got[..., 0, 0], 2 * inner[..., 0] - inner[..., 1])
        torch.testing.assert_close(got[..., 1, :], torch.tensor([2.0, 0.0]).double().expand(1, 20, 2))
        torch.testing.assert_close(got[..., 2, :], torch.tensor([-1.0, 1.0]).double().expand(1, 20, 2))


def test_rows_are_read_alike_on_all_devices() -> None:
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(30, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    cell = torch.randint(30, (7, 4), generator=generator)
    weights = torch.randn(3, 7, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    found = [rows(table, cell, weights) for rows in (gathered_rows, bagged_rows)]
    torch.testing.assert_close(found[0], found[1])
    gradients = [torch.autograd.grad(each.square().sum(), (table, weights)) for each in found]
    torch.testing.assert_close(gradients[0], gradients[1])

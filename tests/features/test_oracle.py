import pytest
import torch

import foundpose.features.oracle as oracle
import foundpose.rendering.coordinates as coordinates
from foundpose.features import CoordinateCode, PatchNoise
from foundpose.geometry import make_transform
from foundpose.rendering import CoordinateRenderer


def test_colours_mean_the_same_to_renderer_and_extractor():
    assert oracle._COLOR_CENTRE == coordinates.COLOR_CENTRE
    assert oracle._COLOR_RANGE == coordinates.COLOR_RANGE
    assert oracle._DARKEST < coordinates.COLOR_CENTRE - 0.5 * coordinates.COLOR_RANGE


@pytest.mark.parametrize("scale", [1.0, 1.005])
def test_colours_are_model_coordinates(blob, scale):
    """Also under an annotated rotation whose scale is not quite 1."""
    T = make_transform(scale * torch.eye(3), torch.tensor([3.0, -5.0, 600.0]))[None].double()
    K = torch.tensor([[[900.0, 0.0, 99.5], [0.0, 900.0, 99.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    render = CoordinateRenderer()(blob, T, K, (200, 200))
    colors = render.rgb[0].permute(1, 2, 0)[render.mask[0]]
    points = (colors - 0.5) / 0.8 * blob.diameter + blob.bounds.mean(0)
    v, u = torch.nonzero(render.mask[0], as_tuple=True)
    projected = (points @ T[0, :3, :3].T + T[0, :3, 3]) @ K[0].T
    assert (projected[:, 0] / projected[:, 2] - u).abs().max() < 0.01
    assert (projected[:, 1] / projected[:, 2] - v).abs().max() < 0.01
    assert colors.min() >= 0.09
    assert colors.max() <= 0.91
    assert (render.rgb[0].permute(1, 2, 0)[~render.mask[0]] == 0).all()


def picture_of(point):
    """A coordinate picture that shows one point (in diameters from the centre) everywhere."""
    return (0.5 + 0.8 * torch.tensor(point).double()).reshape(1, 3, 1, 1).expand(1, 3, 420, 420)


def test_near_points_have_near_codes_and_far_points_do_not():
    code = CoordinateCode().double()
    here, near, far = (
        code(picture_of(p)).patches[0, :, 7, 7] for p in ([0.1, 0, 0], [0.12, 0, 0], [-0.3, 0.2, 0.1])
    )
    assert here.norm() == pytest.approx(40, rel=0.15)
    assert (here - near).norm() < 0.15 * (here - far).norm()
    # The expected kernel of random Fourier features: mean of cos(ω · Δ) over their frequencies.
    delta = torch.tensor([0.02, 0, 0]).double()
    expected = 2 * 40**2 * (1 - torch.cos(delta @ code.directions).mean())
    assert (here - near).square().sum() == pytest.approx(expected.item(), rel=0.25)


def test_background_is_random_and_differs_between_cells():
    patches = CoordinateCode()(torch.zeros(2, 3, 420, 420)).patches
    assert torch.allclose(patches[0], patches[1], atol=1e-3)
    assert patches[0].flatten(1).norm(dim=0).mean() == pytest.approx(40, rel=0.05)
    assert (patches[0, :, 0, 0] - patches[0, :, 0, 1]).norm() > 40
    with pytest.raises(ValueError, match=r"\(B, 3, S, S\), got \(1, 3, 420, 400\)"):
        CoordinateCode()(torch.zeros(1, 3, 420, 400))


def test_noise_replaces_its_share_and_nothing_else():
    clean, noisy = CoordinateCode(), PatchNoise(CoordinateCode(), 0.3, seed=4)
    images = torch.rand(2, 3, 420, 420, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1
    before, after = clean(images).patches, noisy(images).patches
    changed = (before != after).any(dim=1)
    assert changed.float().mean() == pytest.approx(0.3, abs=0.05)
    assert torch.equal(changed[0], changed[1])
    assert torch.allclose(noisy(images[1:]).patches, after[1:], atol=1e-3)
    assert noisy.fingerprint() == clean.fingerprint()
    hit = after.permute(0, 2, 3, 1)[changed]
    assert hit.norm(dim=1).mean() == pytest.approx(before.norm(dim=1).mean().item(), rel=0.1)
    with pytest.raises(ValueError, match=r"fraction must be in \[0, 1\], got 1.5"):
        PatchNoise(clean, 1.5)

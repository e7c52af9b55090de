import pytest
import torch
from safetensors.torch import save_file

from foundpose.refinement import UpdateNetwork
from foundpose.refinement.network import local_correlation
from tests.refinement.learned import small_network, stirred_network


def test_save_and_load(tmp_path):
    network = stirred_network(seed=3)
    path = tmp_path / "deep" / "refiner.safetensors"
    network.save(path)
    assert [p.name for p in path.parent.iterdir()] == ["refiner.safetensors"]
    again = small_network(weights=path)
    pictures = torch.rand(2, 6, 64, 64)
    assert torch.equal(network(pictures), again(pictures))
    assert not torch.equal(network(pictures), small_network()(pictures))
    for build, error, message in [
        (lambda: small_network(weights=tmp_path / "none"), FileNotFoundError, "train_refiner.py"),
        (lambda: small_network(hidden=8, weights=path), ValueError, "settings here are"),
    ]:
        with pytest.raises(error, match=message):
            build()
    (tmp_path / "text").write_text("no tensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other")
    with torch.no_grad():
        network.sharpness.fill_(torch.inf)
    network.save(tmp_path / "broken")
    for name, message in [("text", "readable"), ("other", "no refiner network"), ("broken", "not finite")]:
        with pytest.raises(ValueError, match=message):
            small_network(weights=tmp_path / name)


def test_equal_settings_make_equal_networks():
    torch.manual_seed(0)
    a = small_network()
    torch.rand(3)
    b = small_network()
    for p, q in zip(a.parameters(), b.parameters(), strict=True):
        assert torch.equal(p, q)
    assert not torch.equal(a.features[0][0].weight, small_network(seed=1).features[0][0].weight)


def test_correlation_finds_a_shifted_picture():
    """A picture moved by two cells is found two cells away, under another light too."""
    network = UpdateNetwork()
    crop = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    rendering = 0.6 * torch.roll(crop, (-8, 4), dims=(2, 3)) + 0.1
    correlation = local_correlation(crop, rendering, network.index, network.inside, 16)
    best = network.offsets[correlation.argmax(-1)[0]].reshape(16, 16, 2) * 4
    inner = best[3:-3, 3:-3]
    assert (inner == torch.tensor([-1.0, 2.0])).all()
    plain = local_correlation(0 * crop + 0.5, rendering, network.index, network.inside, 16)
    assert torch.isfinite(plain).all()
    assert plain.abs().max() < 1e-3


def test_bad_arguments():
    for arguments, message in [({"width": 12}, "multiple of 8, got 12"), ({"grid": 6}, "got 6, 2 and 16")]:
        with pytest.raises(ValueError, match=message):
            small_network(**arguments)
    with pytest.raises(ValueError, match=r"multiple of 8, got \(1, 6, 60, 60\)"):
        small_network()(torch.zeros(1, 6, 60, 60))

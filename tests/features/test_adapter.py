import copy
import json

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from foundpose.features import AdaptedExtractor, DenseSift, PatchExtractor, PatchFeatures, ResidualAdapter


class Linear(PatchExtractor):
    """Patches of 14 px through one trainable layer."""

    def __init__(self, channels=12):
        super().__init__(channels, 14.0, 6.5)
        generator = torch.Generator().manual_seed(0)
        self.weight = nn.Parameter(0.1 * torch.randn(channels, 3, 14, 14, generator=generator))

    def forward(self, images):
        patches = nn.functional.conv2d(images, self.weight.to(images.dtype), stride=14)
        return PatchFeatures(patches, patches.mean(dim=(2, 3)))

    def fingerprint(self):
        return {"extractor": "Linear", "channels": self.channels}


def trained(channels=12, hidden=7, seed=0, dtype=torch.float32):
    """An adapter that is not the identity."""
    adapter = ResidualAdapter(channels, hidden, seed).to(dtype)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in adapter.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator, dtype=dtype)
    return adapter


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 40.0])
def test_identity_before_training(dtype, scale, generator):
    x = (torch.randn(2, 5, 3, 12, generator=generator) * scale).to(dtype)
    x[0, 0, 0] = 0
    assert torch.equal(ResidualAdapter(12)(x), x)


def test_formula_length_and_scale(generator):
    adapter = trained(dtype=torch.float64)
    x = torch.randn(50, 12, generator=generator, dtype=torch.float64)
    y = adapter(x)
    assert (y - x).norm(dim=-1).min() > 0.1
    assert torch.allclose(y.norm(dim=-1), x.norm(dim=-1))
    assert torch.allclose(adapter(37.0 * x), 37.0 * y)
    # Written out for one descriptor.
    root_mean_square = x[3].square().mean().sqrt()
    inner = adapter.inner.weight @ (x[3] / root_mean_square) + adapter.inner.bias
    inner = inner * 0.5 * (1 + torch.erf(inner / 2**0.5))
    turned = x[3] / root_mean_square + adapter.outer.weight @ inner + adapter.outer.bias
    assert torch.allclose(y[3], turned / turned.norm() * x[3].norm())
    assert torch.equal(adapter(torch.zeros(2, 12).double()), torch.zeros(2, 12).double())


def test_gradients_agree_with_finite_differences(generator):
    adapter = trained(channels=4, hidden=3, dtype=torch.float64)
    x = torch.randn(3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    names, values = zip(*adapter.named_parameters(), strict=True)

    def call(x, *parameters):
        return torch.func.functional_call(adapter, dict(zip(names, parameters, strict=True)), (x,))

    assert torch.autograd.gradcheck(call, (x, *values))


def test_gradients_at_the_start_and_at_zero(generator):
    adapter = ResidualAdapter(12)
    x = torch.randn(6, 12, generator=generator)
    x[2] = 0
    x.requires_grad_()
    adapter(x)[:, :5].square().sum().backward()
    assert torch.equal(x.grad[2], torch.zeros(12))
    assert torch.isfinite(x.grad).all()
    # The last layer moves first; without it the first one has nothing to go by.
    assert adapter.outer.weight.grad.abs().max() > 0
    assert torch.equal(adapter.inner.weight.grad, torch.zeros_like(adapter.inner.weight))


def test_equal_settings_make_equal_adapters():
    torch.manual_seed(1)
    first = ResidualAdapter(12)
    torch.manual_seed(2)
    assert ResidualAdapter(12).checksum() == first.checksum()
    assert ResidualAdapter(12, seed=1).checksum() != first.checksum()
    assert trained().checksum() != ResidualAdapter(12, 7).checksum()


def test_save_and_load(tmp_path, generator):
    adapter = trained()
    adapter.save(tmp_path / "deep" / "adapter.safetensors")
    again = ResidualAdapter.load(tmp_path / "deep" / "adapter.safetensors")
    x = torch.randn(4, 12, generator=generator)
    assert torch.equal(adapter(x), again(x))
    assert again.checksum() == adapter.checksum()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["adapter.safetensors"]
    assert (
        ResidualAdapter.load(_saved(trained(dtype=torch.float64), tmp_path)).inner.weight.dtype
        == torch.float64
    )


def _saved(adapter, folder):
    adapter.save(folder / "other.safetensors")
    return folder / "other.safetensors"


def test_wrong_files_are_refused(tmp_path):
    path = tmp_path / "adapter.safetensors"
    with pytest.raises(FileNotFoundError, match="train one with"):
        ResidualAdapter.load(path)
    path.write_bytes(b"no safetensors")
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        ResidualAdapter.load(path)
    tensors = {name: value.detach() for name, value in trained().state_dict().items()}
    save_file(tensors, path)
    with pytest.raises(ValueError, match="holds no adapter"):
        ResidualAdapter.load(path)

    def write(facts, tensors):
        save_file(tensors, path, metadata={"foundpose_adapter": json.dumps(facts)})

    facts = {"schema_version": 1, "channels": 12, "hidden": 7}
    write(facts | {"schema_version": 99}, tensors)
    with pytest.raises(ValueError, match="schema version 99"):
        ResidualAdapter.load(path)
    write(facts | {"hidden": 8}, tensors)
    with pytest.raises(ValueError, match="should hold the tensors"):
        ResidualAdapter.load(path)
    write(facts, tensors | {"outer.bias": torch.full((12,), torch.nan)})
    with pytest.raises(ValueError, match="not finite"):
        ResidualAdapter.load(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match="not a readable"):
        ResidualAdapter.load(path)
    trained().save(path)
    with pytest.raises(ValueError, match=r"12 channels, the extractor's have 256"):
        AdaptedExtractor(DenseSift(), weights=path)
    with pytest.raises(ValueError, match="not both"):
        AdaptedExtractor(Linear(), trained(), path)
    with pytest.raises(ValueError, match="at least 1, got 12 and 0"):
        ResidualAdapter(12, 0)
    with pytest.raises(ValueError, match=r"\(..., 12\), got \(3, 5\)"):
        trained()(torch.zeros(3, 5))


def test_adapted_extractor_changes_patches_alone(tmp_path, generator):
    inner = DenseSift(supports=[28.0])
    images = torch.rand(2, 3, 70, 70, generator=generator)
    plain, untrained = inner(images), AdaptedExtractor(inner)
    assert torch.equal(untrained(images).patches, plain.patches)
    adapter = trained(channels=128)
    extractor = AdaptedExtractor(inner, adapter)
    features = extractor(images)
    assert features.patches.shape == plain.patches.shape
    cell = adapter(plain.patches[1, :, 3, 2])
    assert torch.allclose(features.patches[1, :, 3, 2], cell, atol=1e-6)
    assert not torch.allclose(features.patches, plain.patches, atol=1e-2)
    assert extractor.patch_grid(70).size == inner.patch_grid(70).size
    # Alone as in a batch.
    assert torch.allclose(extractor(images[1:]).patches[0], features.patches[1], atol=1e-6)
    # From a file.
    adapter.save(tmp_path / "adapter.safetensors")
    loaded = AdaptedExtractor(inner, weights=tmp_path / "adapter.safetensors")
    assert torch.equal(loaded(images).patches, features.patches)
    with_cls = AdaptedExtractor(Linear(), trained())
    assert torch.equal(with_cls(images).cls, Linear()(images).cls)


@pytest.mark.parametrize("frozen", [True, False])
def test_gradients_reach_what_is_trainable(frozen, generator):
    extractor = AdaptedExtractor(Linear(), trained())
    extractor.extractor.requires_grad_(not frozen)
    extractor(torch.rand(1, 3, 42, 42, generator=generator)).patches.square()[:, :6].sum().backward()
    for parameter in extractor.adapter.parameters():
        assert torch.isfinite(parameter.grad).all()
        assert parameter.grad.abs().max() > 0
    grad = extractor.extractor.weight.grad
    assert grad is None if frozen else grad.abs().max() > 0


def test_fingerprint_follows_weights_and_extractor():
    adapter = trained()
    fingerprint = AdaptedExtractor(Linear(), adapter).fingerprint()
    assert fingerprint == AdaptedExtractor(Linear(), copy.deepcopy(adapter)).fingerprint()
    assert Linear().fingerprint().items() <= fingerprint.items()
    other = copy.deepcopy(adapter)
    with torch.no_grad():
        other.outer.bias[3] += 1e-6
    assert AdaptedExtractor(Linear(), other).fingerprint() != fingerprint
    assert AdaptedExtractor(Linear(), ResidualAdapter(12, 8)).fingerprint() != fingerprint
    assert AdaptedExtractor(Linear()).fingerprint() == AdaptedExtractor(Linear()).fingerprint()
    json.dumps(fingerprint)

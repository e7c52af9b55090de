import numpy as np
import pytest
import torch
from torch import nn

from foundpose.features.dinov2 import DinoV2
from foundpose.features.resample import resample_position_embeddings
from foundpose.features.weights import weights_checksum

TINY = {"hidden_size": 32, "num_hidden_layers": 6, "num_attention_heads": 4, "image_size": 70}


def tiny(variant: str = "vits14_reg", layer: int = 3, seed: int = 0, **kwargs) -> DinoV2:
    return DinoV2(variant, layer, seed=seed, config=TINY, **kwargs, weights="random")


@pytest.fixture
def images(generator) -> torch.Tensor:
    return torch.rand(3, 3, 56, 56, generator=generator)


@pytest.mark.parametrize("variant", ["vits14", "vitb14_reg", "vitg14"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_shapes_and_dtypes(variant: str, dtype: torch.dtype, images) -> None:
    extractor = tiny(variant).to(dtype)
    out = extractor(images.to(dtype))
    assert out.patches.shape == (3, 32, 4, 4)
    assert out.cls.shape == (3, 32)
    assert out.patches.dtype == out.cls.dtype == dtype
    assert torch.isfinite(out.patches).all()
    assert extractor(images[:0].to(dtype)).patches.shape == (0, 32, 4, 4)


def test_paper_setting_at_full_resolution() -> None:
    extractor = DinoV2("vits14_reg", layer=1, weights="random", seed=0)
    with torch.no_grad():
        out = extractor(torch.rand(1, 3, 420, 420))
    assert out.patches.shape == (1, 384, 30, 30)
    assert (extractor.stride, extractor.offset, extractor.patch_grid(420).size) == (14, 6.5, 30)
    assert extractor.channels == 384


def test_no_block_behind_the_layer_is_built_or_run(images) -> None:
    calls: list[int] = []
    extractor = tiny(layer=2)
    blocks = extractor.model.encoder.layer
    for k, block in enumerate(blocks):
        block.register_forward_hook(lambda *_, k=k: calls.append(k))
    extractor(images)
    assert len(blocks) == 3
    assert calls == [0, 1, 2]


def test_layer_is_counted_from_zero_and_does_not_depend_on_what_follows(images, tmp_path) -> None:
    """Tokens of the truncated model equal those hooked in the whole one; registers are dropped."""
    whole = tiny(layer=5)
    whole.model.save_pretrained(tmp_path)
    extractor = DinoV2("vits14_reg", 2, final_norm=False, weights=tmp_path, config=TINY)
    tokens = {}
    whole.model.encoder.layer[2].register_forward_hook(lambda m, i, o: tokens.update(t=o))
    whole(images)
    hooked = tokens["t"] if torch.is_tensor(tokens["t"]) else tokens["t"][0]
    assert hooked.shape[1] == 1 + 4 + 16
    out = extractor(images)
    torch.testing.assert_close(out.cls, hooked[:, 0])
    torch.testing.assert_close(out.patches.flatten(2).transpose(1, 2), hooked[:, 5:])
    # row by row: cell (row, column) is token 4 * row + column
    torch.testing.assert_close(out.patches[:, :, 1, 2], hooked[:, 5 + 6])


def test_final_norm_normalises_the_hooked_tokens(images) -> None:
    normed, raw = tiny()(images), tiny(final_norm=False)(images)
    expected = nn.functional.layer_norm(raw.patches.permute(0, 2, 3, 1), (32,), eps=1e-6)
    torch.testing.assert_close(normed.patches.permute(0, 2, 3, 1), expected, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(normed.patches, raw.patches, atol=1e-2)


def test_sample_alone_equals_sample_in_batch(images) -> None:
    extractor = tiny().double()
    together = extractor(images.double())
    for k in range(3):
        alone = extractor(images[k : k + 1].double())
        torch.testing.assert_close(alone.patches[0], together.patches[k], atol=1e-10, rtol=0)


def test_gradients_reach_images_and_every_parameter(images) -> None:
    # trained weights have none of random initialisation's exact zeros, behind which gradients vanish
    extractor = tiny()
    with torch.no_grad():
        for p in extractor.parameters():
            p.add_(0.02 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1)))
    images.requires_grad_(True)
    out = extractor(images)
    weights = torch.randn(out.patches.shape, generator=torch.Generator().manual_seed(2))
    (out.patches * weights).sum().backward()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert images.grad.abs().amax(dim=(1, 2, 3)).min() > 0
    for name, p in extractor.named_parameters():
        if not name.endswith("mask_token"):
            assert p.grad is not None, name
            assert torch.isfinite(p.grad).all(), name
            assert p.grad.abs().sum() > 0, name


def test_image_gradient_equals_finite_differences(images) -> None:
    extractor = tiny(layer=1).double()
    x = images[:1].double().requires_grad_(True)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(t: torch.Tensor) -> torch.Tensor:
        return extractor(t).patches.sin().sum()

    (grad,) = torch.autograd.grad(value(x), x)
    h = 1e-5
    numeric = (value(x + h * direction) - value(x - h * direction)) / (2 * h)
    torch.testing.assert_close((grad * direction).sum(), numeric, rtol=1e-6, atol=1e-8)


def test_bf16_autocast_is_close_and_keeps_the_dtype(images) -> None:
    exact, fast = tiny(), tiny(precision="bf16")
    out, expected = fast(images), exact(images)
    assert out.patches.dtype == torch.float32
    assert not torch.equal(out.patches, expected.patches)
    similarity = nn.functional.cosine_similarity(out.patches, expected.patches, dim=1)
    assert similarity.min() > 0.999  # bfloat16 has 8 bits: 0.4 % per operation
    assert fast.fingerprint() == exact.fingerprint()


def test_seed_decides_random_weights_and_leaves_the_global_generator_alone(images) -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    a, b, c = tiny(seed=1), tiny(seed=1), tiny(seed=2)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(a(images).patches, b(images).patches)
    assert not torch.allclose(a(images).patches, c(images).patches, atol=1e-3)


def test_fingerprint_tells_extractors_apart() -> None:
    base = tiny().fingerprint()
    assert tiny().fingerprint() == base
    others = [tiny(layer=2), tiny(seed=1), tiny(final_norm=False), tiny("vitb14_reg")]
    prints = [str(sorted(x.fingerprint().items())) for x in others]
    assert str(sorted(base.items())) not in prints
    assert len(set(prints)) == len(prints)
    trained = tiny()
    with torch.no_grad():
        next(trained.model.encoder.parameters()).view(-1)[0] += 1e-6
    assert trained.fingerprint() != base


def test_checksum_ignores_device_and_float_type_but_not_values() -> None:
    model = nn.Linear(3, 2)
    checksum = weights_checksum(model)
    assert weights_checksum(model.double()) == checksum
    model.float()
    assert weights_checksum(model) == checksum
    model.weight.data[0, 0] += 1e-3
    assert weights_checksum(model) != checksum


def cubic_weights(position: float, n: int) -> torch.Tensor:
    """Weights (n,) of torch's cubic convolution (a = -0.75) at a position, edges repeated."""
    first = int(np.floor(position)) - 1
    weights = torch.zeros(n, dtype=torch.float64)
    for k in range(first, first + 4):
        x = abs(position - k)
        a = -0.75
        inner = (a + 2) * x**3 - (a + 3) * x**2 + 1
        outer = a * (x**3 - 5 * x**2 + 8 * x - 4)
        weights[min(max(k, 0), n - 1)] += inner if x < 1 else outer
    return weights


def test_position_embeddings_are_sampled_where_the_original_samples_them() -> None:
    """Embedding k of m is read at (k + 0.5) n / (m + 0.1) - 0.5, both ways."""
    n, m = 37, 30
    embeddings = torch.randn(1, 1 + n * n, 3, dtype=torch.float64)
    out = resample_position_embeddings(embeddings, m, m)
    W = torch.stack([cubic_weights((k + 0.5) * n / (m + 0.1) - 0.5, n) for k in range(m)])
    expected = torch.einsum("in,jm,nmc->ijc", W, W, embeddings[0, 1:].reshape(n, n, 3))
    torch.testing.assert_close(out[0, 1:].reshape(m, m, 3), expected, atol=1e-10, rtol=0)
    assert torch.equal(out[:, 0], embeddings[:, 0])
    assert resample_position_embeddings(embeddings, n, n) is embeddings


@pytest.mark.parametrize("variant", ["vits14", "vits14_reg"])
def test_without_a_border_the_blocks_see_the_inner_patches_alone_in_their_places(variant, generator) -> None:
    extractor = tiny(variant).double()
    images = torch.rand(3, 3, 84, 84, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        out = extractor(images, 2)
        # The same by hand: tokens of rows and columns 2 and 3 of 6, behind cls and registers.
        tokens = extractor.model.embeddings((images - extractor.mean) / extractor.std)
        prefix = tokens.shape[1] - 36
        cells = [14, 15, 20, 21]
        tokens = tokens[:, [*range(prefix), *(prefix + cell for cell in cells)]]
        for block in extractor.model.encoder.layer:
            tokens = block(tokens)
        tokens = extractor.model.layernorm(tokens)
    patches = out.patches.flatten(2).mT.clone()
    torch.testing.assert_close(patches[:, cells], tokens[:, prefix:], atol=1e-10, rtol=0)
    torch.testing.assert_close(out.cls, tokens[:, 0], atol=1e-10, rtol=0)
    patches[:, cells] = 0
    assert not patches.any()
    with torch.no_grad():
        torch.testing.assert_close(extractor(images[1:2], 2).patches[0], out.patches[1], atol=1e-10, rtol=0)


@pytest.mark.parametrize("variant", ["vits14", "vits14_reg"])
def test_with_no_border_the_parts_make_the_whole(variant, images) -> None:
    extractor = tiny(variant).double()
    pixels = ((images.double() - extractor.mean) / extractor.std).requires_grad_()
    part, whole = extractor.describe_within(pixels, 0), extractor.describe(pixels)
    torch.testing.assert_close(part, whole, atol=1e-10, rtol=0)
    gradients = [torch.autograd.grad(found.patches.square().sum(), pixels)[0] for found in (part, whole)]
    torch.testing.assert_close(*gradients, atol=1e-9, rtol=1e-9)


def test_gradients_leave_the_border_out(generator) -> None:
    images = torch.rand(1, 3, 84, 84, generator=generator).requires_grad_()
    extractor = tiny()
    (gradient,) = torch.autograd.grad(extractor(images, 1).patches.square().sum(), images)
    assert gradient[..., 14:70, 14:70].abs().amax(1).gt(0).float().mean() > 0.99
    gradient[..., 14:70, 14:70] = 0
    assert not gradient.any()


def test_bad_borders_are_refused(images) -> None:
    for border in (2, -1):
        with pytest.raises(ValueError, match=f"must leave some of the 4 × 4 patches, got {border}"):
            tiny()(images, border)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.rand(3, 56, 56), r"\(B, 3, S, S\), got \(3, 56, 56\)"),
        (torch.rand(1, 1, 56, 56), r"got \(1, 1, 56, 56\)"),
        (torch.rand(1, 3, 56, 70), r"got \(1, 3, 56, 70\)"),
        (torch.rand(1, 3, 60, 60), "multiple of 14 px, got 60.*56 or 70"),
        (torch.rand(1, 3, 7, 7), "multiple of 14 px, got 7"),
        (torch.zeros(1, 3, 56, 56, dtype=torch.uint8), "uint8; divide by 255"),
        (torch.full((1, 3, 56, 56), 200.0), r"\[0, 1\], got values in \[200, 200\]"),
        (torch.full((1, 3, 56, 56), -2.0), r"got values in \[-2, -2\]"),
    ],
)
def test_bad_images_are_refused(images: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny()(images)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"variant": "vitx14"}, "variant must be one of vits14"),
        ({"layer": 6}, r"layer must be in 0\.\.5"),
        ({"layer": -1}, "layer must be in"),
        ({"precision": "fp8"}, "precision must be"),
        ({"seed": None}, "goes with a seed"),
        ({"weights": "hub"}, "goes with a seed"),
        ({"config": {"width": 3}}, "unknown keys"),
        ({"config": {**TINY, "num_register_tokens": 0}}, "cannot have 0 register tokens"),
    ],
)
def test_bad_settings_are_refused(kwargs: dict, message: str) -> None:
    settings = {"variant": "vits14_reg", "layer": 3, "weights": "random", "seed": 0, "config": TINY}
    with pytest.raises(ValueError, match=message):
        DinoV2(**{**settings, **kwargs})


def test_state_dict_round_trip(images) -> None:
    a, b = tiny(seed=1), tiny(seed=2)
    b.load_state_dict(a.state_dict())
    assert torch.equal(a(images).patches, b(images).patches)

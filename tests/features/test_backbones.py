"""What all pretrained extractors promise."""

import pytest
import torch
from torch import Tensor, nn

from foundpose.features import Clip, DinoV2, DinoV3, LoftrBackbone, S2DNet, Sam, VisionTransformer
from tests.features.backbones import ALL, CLIP, DINOV3, SAM, TRANSFORMERS, make, shake

CHANNELS = {"loftr": 256, "loftr_fine": 128, "s2dnet": 128, "s2dnet_all": 384}
# Patches along the side of a picture: few for the large networks, and fewer in bfloat16, in which convolutions take
# minutes on some processors.
SIDES = dict.fromkeys(CHANNELS, 2)
SIDES_BF16 = dict.fromkeys(CHANNELS, 1)


@pytest.fixture
def name() -> str:
    """Of the network, for the size of its pictures; most tests run for several."""
    return ""


@pytest.fixture
def images(generator, name) -> Tensor:
    side = 14 * SIDES.get(name, 4)
    return torch.rand(3, 3, side, side, generator=generator)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_shapes_and_dtypes(name: str, dtype: torch.dtype, images) -> None:
    extractor = make(name).to(dtype)
    channels = CHANNELS.get(name, 32)
    assert extractor.channels == channels
    side = (SIDES_BF16 if dtype == torch.bfloat16 else SIDES).get(name, 4)
    images = images[..., : 14 * side, : 14 * side]
    with torch.no_grad():
        out = extractor(images.to(dtype))
        empty = extractor(images[:0].to(dtype))
    has_cls = name in ("dino", "dinov3", "clip", "clip16")
    assert out.patches.shape == (3, channels, side, side)
    assert empty.patches.shape == (0, channels, side, side)
    assert out.patches.dtype == dtype
    assert torch.isfinite(out.patches).all()
    assert (out.cls is not None) == (empty.cls is not None) == has_cls
    if has_cls:
        assert out.cls.shape == (3, channels)
        assert out.cls.dtype == dtype


@pytest.mark.parametrize("name", [*TRANSFORMERS, "loftr", "s2dnet"])
def test_crop_of_the_paper_has_30_by_30_patches(name: str) -> None:
    extractor = make(name)
    with torch.no_grad():
        out = extractor(torch.rand(1, 3, 420, 420))
    assert out.patches.shape == (1, extractor.channels, 30, 30)
    assert (extractor.stride, extractor.offset, extractor.patch_grid(420).size) == (14, 6.5, 30)


def test_networks_that_cannot_leave_patches_out_say_so() -> None:
    with pytest.raises(ValueError, match="Sam cannot leave out patches; border must be 0, got 1"):
        make("sam")(torch.rand(1, 3, 56, 56), 1)


def test_sam_at_its_own_resolution() -> None:
    extractor = make("sam", layer=1, config={**SAM, "image_size": 1024, "window_size": 14})
    with torch.no_grad():
        assert extractor(torch.rand(1, 3, 420, 420)).patches.shape == (1, 32, 30, 30)


@pytest.mark.parametrize("name", ALL)
def test_sample_alone_equals_sample_in_batch_also_in_training(name: str, images) -> None:
    extractor = make(name).double()
    with torch.no_grad():
        together = extractor(images.double())
        nn.Sequential(extractor).train()
        assert extractor.training
        for k in range(3):
            alone = extractor(images[k : k + 1].double())
            torch.testing.assert_close(alone.patches[0], together.patches[k], atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", ALL)
def test_seed_decides_random_weights_and_leaves_the_global_generator_alone(name: str, images) -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    a, b, c = make(name, seed=1), make(name, seed=1), make(name, seed=2)
    assert torch.equal(torch.get_rng_state(), before)
    with torch.no_grad():
        assert torch.equal(a(images).patches, b(images).patches)
        assert not torch.allclose(a(images).patches, c(images).patches, atol=1e-3)
    assert a.fingerprint() == b.fingerprint() != c.fingerprint()


@pytest.mark.parametrize("name", ALL)
def test_gradients_reach_images_and_every_parameter(name: str, images) -> None:
    extractor = shake(make(name))
    x = images.requires_grad_(True)
    out = extractor(x)
    g = torch.Generator().manual_seed(2)
    loss = (out.patches * torch.randn(out.patches.shape, generator=g)).sum()
    loss.backward()
    assert torch.isfinite(x.grad).all()
    assert x.grad.abs().amax(dim=(1, 2, 3)).min() > 0
    for parameter, p in extractor.named_parameters():
        if not parameter.endswith("mask_token"):
            assert p.grad is not None, parameter
            assert torch.isfinite(p.grad).all(), parameter
            assert p.grad.abs().sum() > 0, parameter


@pytest.mark.parametrize("name", ALL)
def test_image_gradient_equals_finite_differences(name: str, images) -> None:
    extractor = make(name).double()
    x = images[:1].double().requires_grad_(True)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(t: Tensor) -> Tensor:
        return extractor(t).patches.sin().sum()

    (grad,) = torch.autograd.grad(value(x), x)
    h = 1e-8 if name in CHANNELS else 1e-5  # those have ReLUs: keep their kinks out of reach
    with torch.no_grad():
        numeric = (value(x + h * direction) - value(x - h * direction)) / (2 * h)
    torch.testing.assert_close((grad * direction).sum(), numeric, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_bf16_autocast_is_close_and_keeps_the_dtype(name: str, images) -> None:
    exact, fast = make(name), make(name, precision="bf16")
    side = 14 * SIDES_BF16.get(name, 4)
    images = images[:1, :, :side, :side]
    with torch.no_grad():
        out, expected = fast(images), exact(images)
    assert out.patches.dtype == torch.float32
    assert not torch.equal(out.patches, expected.patches)
    similarity = nn.functional.cosine_similarity(out.patches, expected.patches, dim=1)
    assert similarity.min() > 0.99  # 8 bits: 0.4 % per operation, and up to 20 convolutions in a row
    assert fast.fingerprint() == exact.fingerprint()


def test_gradients_after_a_first_call_in_inference_mode(images) -> None:
    """Rotary coordinates are cached between calls."""
    extractor = make("dinov3")
    with torch.inference_mode():
        extractor(images)
    extractor(images).patches.sum().backward()


@pytest.mark.parametrize("name", ALL)
def test_fingerprint_follows_the_weights(name: str) -> None:
    extractor = make(name)
    before = extractor.fingerprint()
    with torch.no_grad():
        next(extractor.model.parameters()).view(-1)[0] += 1e-3
    assert extractor.fingerprint() != before


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("dinov3", {"layer": 1}),
        ("dinov3", {"final_norm": False}),
        ("clip", {"layer": 1}),
        ("clip", {"final_norm": True}),
        ("sam", {"layer": 1}),
        ("sam", {"variant": "vitb"}),
        ("loftr", {"level": "fine"}),
        ("s2dnet", {"layers": ["conv3_3"]}),
    ],
)
def test_fingerprint_follows_the_settings(name: str, other: dict) -> None:
    assert make(name).fingerprint() != make(name, **other).fingerprint()


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.rand(3, 56, 56), r"\(B, 3, S, S\), got \(3, 56, 56\)"),
        (torch.rand(1, 3, 60, 60), "multiple of 14 px, got 60.*56 or 70"),
        (torch.full((1, 3, 56, 56), 200.0), r"\[0, 1\], got values in \[200, 200\]"),
    ],
)
@pytest.mark.parametrize("name", ["sam", "loftr"])
def test_bad_images_are_refused(name: str, images: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(name)(images)


@pytest.mark.parametrize(
    ("extractor", "kwargs", "message"),
    [
        (DinoV3, {"variant": "vitx16"}, "variant must be one of vits16"),
        (Clip, {"variant": "vitx16"}, "variant must be one of vitb32"),
        (Sam, {"variant": "vitx16"}, "variant must be one of vitb, vitl, vith"),
        (LoftrBackbone, {"variant": "sky"}, "variant must be one of outdoor"),
        (LoftrBackbone, {"level": "middle"}, "level must be one of coarse, fine"),
        (S2DNet, {"layers": ["conv4_3"]}, "different of conv1_2, conv3_3, conv5_3"),
        (S2DNet, {"layers": []}, "layers must be one or more"),
        (S2DNet, {"layers": ["conv5_3", "conv5_3"]}, "layers must be one or more different"),
        (DinoV3, {"layer": 24}, r"layer must be in 0\.\.23 for vitl16, got 24"),
        (Sam, {"layer": -1}, r"layer must be in 0\.\.23"),
        (Clip, {"config": {"width": 3}}, "unknown keys"),
        (DinoV3, {"config": {**DINOV3, "depth": 3}}, "unknown keys"),
        (Clip, {"layer": 4, "config": CLIP}, r"0\.\.3"),
        *[(e, {"precision": "fp8"}, "precision must be") for e in (DinoV3, Clip, Sam, LoftrBackbone, S2DNet)],
        *[(e, {"seed": 1}, "goes with a seed") for e in (DinoV3, Clip, Sam, LoftrBackbone, S2DNet)],
        *[(e, {"weights": "random"}, "with a seed") for e in (DinoV3, Clip, Sam, LoftrBackbone, S2DNet)],
    ],
)
def test_bad_settings_are_refused(extractor: type, kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        extractor(**kwargs)


@pytest.mark.parametrize(
    ("family", "depth", "layer"),
    [(DinoV2, 12, 9), (DinoV2, 24, 18), (DinoV2, 40, 30), (DinoV3, 24, 18), (Clip, 24, 23), (Sam, 24, 23)],
)
def test_default_layers_are_the_papers(family: type[VisionTransformer], depth: int, layer: int) -> None:
    small = {"hidden_size": 8, "num_attention_heads": 2, "num_hidden_layers": depth}
    extractor = family(weights="random", seed=0, config=small)
    assert (extractor.layer, extractor.variant) == (layer, family.default_variant)
    assert extractor.fingerprint()["layer"] == layer


def test_sam_has_no_final_norm() -> None:
    with pytest.raises(ValueError, match="Sam has no final LayerNorm"):
        make("sam", final_norm=True)

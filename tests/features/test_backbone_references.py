"""What each network's descriptors are and where they lie, by independent references."""

import pytest
import torch
from torch import Tensor, nn

from tests.features.backbones import SAM, TRANSFORMERS, make, shake

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
OPENAI = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711))


@pytest.fixture
def images(generator) -> Tensor:
    return torch.rand(3, 3, 56, 56, generator=generator)


def resized(images: Tensor, size: int, statistics: tuple) -> Tensor:
    """The network's input by Pillow's rule, which torch follows too: edges of the images on each other."""
    x = nn.functional.interpolate(images, (size, size), mode="bilinear", antialias=True)
    mean, std = (torch.tensor(s)[:, None, None] for s in statistics)
    return (x - mean) / std


@pytest.mark.parametrize("layer", [0, 2, 3])
@pytest.mark.parametrize("final_norm", [True, False])
def test_dinov3_is_a_hidden_state_of_the_whole_model(layer: int, final_norm: bool, images, tmp_path) -> None:
    from transformers import DINOv3ViTModel

    shake(make("dinov3", layer=3)).model.save_pretrained(tmp_path)
    whole = DINOv3ViTModel.from_pretrained(tmp_path, attn_implementation="eager").eval()
    with torch.no_grad():
        tokens = whole(resized(images, 64, IMAGENET), output_hidden_states=True).hidden_states[layer + 1]
        if final_norm:
            tokens = whole.norm(tokens)
        out = make("dinov3", None, tmp_path, layer=layer, final_norm=final_norm)(images)
    torch.testing.assert_close(out.cls, tokens[:, 0], atol=2e-5, rtol=1e-4)
    expected = tokens[:, 5:].unflatten(1, (4, 4)).permute(0, 3, 1, 2)
    torch.testing.assert_close(out.patches, expected, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("layer", [0, 2, 3])
@pytest.mark.parametrize("final_norm", [True, False])
def test_dino_is_a_hidden_state_of_the_whole_model(layer: int, final_norm: bool, images, tmp_path) -> None:
    from transformers import ViTModel

    shake(make("dino", layer=3)).model.save_pretrained(tmp_path)
    whole = ViTModel.from_pretrained(tmp_path, attn_implementation="eager", add_pooling_layer=False).eval()
    with torch.no_grad():
        pixels = resized(images, 32, IMAGENET)
        tokens = whole(pixels, interpolate_pos_encoding=True, output_hidden_states=True).hidden_states[
            layer + 1
        ]
        if final_norm:
            tokens = whole.layernorm(tokens)
        out = make("dino", None, tmp_path, layer=layer, final_norm=final_norm)(images)
    torch.testing.assert_close(out.cls, tokens[:, 0], atol=2e-5, rtol=1e-4)
    expected = tokens[:, 1:].unflatten(1, (4, 4)).permute(0, 3, 1, 2)
    torch.testing.assert_close(out.patches, expected, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("layer", [0, 2, 3])
@pytest.mark.parametrize(("name", "size"), [("clip", 56), ("clip16", 64)])
def test_clip_is_a_hidden_state_of_the_whole_model(
    layer: int, name: str, size: int, images, tmp_path
) -> None:
    from transformers import CLIPVisionModel

    shake(make(name, layer=3, final_norm=True)).model.save_pretrained(tmp_path)
    whole = CLIPVisionModel.from_pretrained(tmp_path, attn_implementation="eager").eval()
    with torch.no_grad():
        pixels = resized(images, size, OPENAI)
        tokens = whole(pixels, interpolate_pos_encoding=True, output_hidden_states=True).hidden_states
        raw = make(name, None, tmp_path, layer=layer)(images)
        normed = make(name, None, tmp_path, layer=layer, final_norm=True)(images)
    torch.testing.assert_close(raw.cls, tokens[layer + 1][:, 0], atol=2e-5, rtol=1e-4)
    expected = tokens[layer + 1][:, 1:].unflatten(1, (4, 4)).permute(0, 3, 1, 2)
    torch.testing.assert_close(raw.patches, expected, atol=2e-5, rtol=1e-4)
    norm = getattr(whole, "vision_model", whole).post_layernorm
    expected = norm(expected.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    torch.testing.assert_close(normed.patches, expected, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("layer", [0, 1, 3])
def test_sam_is_a_hidden_state_of_the_whole_model(layer: int, images, tmp_path) -> None:
    from transformers import SamVisionConfig, SamVisionModel

    # written by hand, for the extractor has dropped the neck
    torch.manual_seed(0)
    config = SamVisionConfig(**{**SAM, "initializer_range": 0.2})
    whole = SamVisionModel._from_config(config, attn_implementation="eager").eval()
    with torch.no_grad():
        for name, p in whole.named_parameters():
            if "pos" in name:
                nn.init.normal_(p, std=0.5)
        whole.save_pretrained(tmp_path)
        states = whole(resized(images, 128, IMAGENET), output_hidden_states=True).hidden_states
        out = make("sam", None, tmp_path, layer=layer)(images)
    # 8 × 8 tokens onto 4 × 4 patches: each centre is the corner where four tokens meet
    expected = nn.functional.avg_pool2d(states[layer + 1].permute(0, 3, 1, 2), 2)
    torch.testing.assert_close(out.patches, expected, atol=5e-5, rtol=1e-4)
    assert out.cls is None


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_no_block_behind_the_layer_is_built(name: str) -> None:
    blocks = [m for m in make(name, layer=1).model.modules() if type(m).__name__.endswith("Layer")]
    assert len(blocks) == 2


def ramp(size: int = 420) -> Tensor:
    """(1, 3, S, S) whose red is u, green v, blue 1 / 2, all scaled to 0..1."""
    axis = torch.arange(size, dtype=torch.float32) / size
    u, v = torch.meshgrid(axis, axis, indexing="xy")
    return torch.stack([u, v, torch.full_like(u, 0.5)])[None]


def pass_patches_through(extractor, mean: tuple, std: tuple) -> None:
    """Weights with which a transformer's tokens are the mean colours of its patches."""
    (conv,) = [m for m in extractor.model.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        for p in extractor.model.parameters():
            p.zero_()
        for k in range(3):
            conv.weight[k, k] = std[k] / conv.weight[k, k].numel()
        if conv.bias is not None:
            conv.bias[:3] = torch.tensor(mean)


@pytest.mark.parametrize(
    ("make_extractor", "size"),
    [
        (lambda: make("dinov3", final_norm=False), None),
        (lambda: make("sam", config={**SAM, "image_size": 1024, "window_size": 14}), 64),
        (lambda: make("sam", config={**SAM, "image_size": 512, "window_size": 14}), 32),
    ],
)
def test_tokens_land_on_the_patch_centres(make_extractor, size) -> None:
    """Resizing and resampling keep coordinates: a picture of its own coordinates describes patches by theirs."""
    extractor = make_extractor()
    pass_patches_through(extractor, *IMAGENET)
    with torch.no_grad():
        found = extractor(ramp()).patches[0, :2] * 420
    centers = extractor.patch_grid(420).centers(found.device, found.dtype).permute(2, 0, 1)
    # at the border enlarging repeats the outermost pixels, which moves the outermost tokens by 0.01 px
    torch.testing.assert_close(found, centers, atol=0.03, rtol=0)
    # coordinates up to 420 px through products in single precision: some 1e-5 of them, as the machine sums
    torch.testing.assert_close(found[:, 2:-2, 2:-2], centers[:, 2:-2, 2:-2], atol=4e-3, rtol=0)


@pytest.mark.parametrize("name", ["loftr", "loftr_fine"])
def test_loftr_is_centred_on_the_patches(name: str) -> None:
    """With kernels that are symmetric, the centroid of what a descriptor sees is the patch's centre."""
    extractor = make(name).double()
    with torch.no_grad():
        for m in extractor.model.modules():
            if isinstance(m, nn.Conv2d):
                m.weight.fill_(1 / m.weight[0].numel())
        if name == "loftr_fine":  # the way down the pyramid has another geometry, that of corners on corners
            extractor.model.layer2_outconv2[3].weight.zero_()
    size, row, column = 168, 6, 5  # the descriptor sees less than the picture
    x = torch.full((1, 3, size, size), 0.5, dtype=torch.float64, requires_grad=True)
    (seen,) = torch.autograd.grad(extractor(x).patches[0, 0, row, column], x)
    weight = seen[0].sum(0)
    assert weight[0].abs().max() == weight[:, -1].abs().max() == 0
    axis = torch.arange(size, dtype=torch.float64)
    u = (weight.sum(0) * axis).sum() / weight.sum()
    v = (weight.sum(1) * axis).sum() / weight.sum()
    assert (u.item(), v.item()) == pytest.approx((14 * column + 6.5, 14 * row + 6.5), abs=1e-6)


@pytest.mark.parametrize("layer", ["conv1_2", "conv3_3", "conv5_3"])
def test_s2dnet_is_centred_on_the_patches(layer: str) -> None:
    """Pooling takes a ramp's upper end, and that of the reversed ramp its lower end: their mean is the centre."""
    extractor = make("s2dnet", layers=[layer])
    with torch.no_grad():
        for p in extractor.model.parameters():
            p.zero_()
        for m in extractor.model.modules():
            if isinstance(m, nn.Conv2d):
                middle = m.kernel_size[0] // 2
                for k in range(3):
                    m.weight[k, k, middle, middle] = 1
            if isinstance(m, nn.BatchNorm2d):
                m.weight.fill_(1)
                m.eps = 0
        extractor.mean.zero_()  # ReLUs pass what is positive
        extractor.std.fill_(1)
        upper = extractor(ramp(210)).patches[0, :2] * 210
        lower = (1 - extractor(1 - ramp(210)).patches[0, :2]) * 210
    centers = extractor.patch_grid(210).centers(upper.device, upper.dtype).permute(2, 0, 1)
    torch.testing.assert_close((upper + lower)[:, 1:-1, 1:-1] / 2, centers[:, 1:-1, 1:-1], atol=2e-3, rtol=0)
    assert (upper - lower).mean() > 1 or layer == "conv1_2"

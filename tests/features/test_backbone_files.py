"""Loading of the published checkpoint files of LoFTR and S2DNet."""

from collections import OrderedDict

import pytest
import torch
from torch import Tensor, nn

from foundpose.features import LoftrBackbone, S2DNet, WeightsNotFoundError
from tests.features.backbones import make


def loftr_checkpoint(prefix: str) -> tuple[nn.Module, dict]:
    """kornia's whole model, and a checkpoint of it."""
    from kornia.feature import LoFTR

    torch.manual_seed(3)
    model = LoFTR(pretrained=None).eval()
    for m in model.modules():
        if isinstance(m, nn.BatchNorm2d):
            nn.init.normal_(m.running_mean, std=0.1)
            nn.init.uniform_(m.running_var, 0.5, 2)
    return model, {"state_dict": OrderedDict((prefix + k, v) for k, v in model.state_dict().items())}


@pytest.mark.parametrize("prefix", ["", "matcher."])
def test_loftr_file_gives_kornias_maps(prefix: str, tmp_path) -> None:
    model, checkpoint = loftr_checkpoint(prefix)
    torch.save(checkpoint, tmp_path / "loftr_outdoor.ckpt")
    images = torch.rand(2, 3, 112, 112)
    coarse = LoftrBackbone(weights=tmp_path / "loftr_outdoor.ckpt")
    fine = LoftrBackbone(level="fine", weights=tmp_path / "loftr_outdoor.ckpt")
    gray = (images * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1, keepdim=True)
    with torch.no_grad():
        maps = model.backbone(gray)
        found = coarse(images).patches, fine(images).patches
    # patch 4 is centred on 62.5: between cells 7 and 8 of the coarse map, 31 and 32 of the fine one
    for patches, features, stride in ((found[0], maps[0], 8), (found[1], maps[1], 2)):
        cell, part = divmod(62.5 / stride, 1)
        k = int(cell)
        left = features[:, :, k : k + 2, k] @ torch.tensor([1 - part, part])
        right = features[:, :, k : k + 2, k + 1] @ torch.tensor([1 - part, part])
        expected = (1 - part) * left + part * right
        torch.testing.assert_close(patches[:, :, 4, 4], expected, atol=1e-4, rtol=1e-4)


def test_loftr_from_the_hub_is_kornias_download(monkeypatch) -> None:
    """kornia is asked for the variant, and not before someone wants its weights."""
    import kornia.feature

    asked = []
    original = kornia.feature.LoFTR

    def loftr(pretrained: str | None) -> nn.Module:
        asked.append(pretrained)
        if pretrained == "indoor":
            raise RuntimeError("no network")
        return original(None)

    monkeypatch.setattr(kornia.feature, "LoFTR", loftr)
    make("loftr", seed=0)
    assert asked == [None]
    LoftrBackbone("indoor_new")
    assert asked == [None, "indoor_new"]
    with pytest.raises(WeightsNotFoundError, match=r"no network\n.*\n.*kornia/loftr loftr_indoor\.ckpt"):
        LoftrBackbone("indoor")


def reference_s2dnet(state: dict[str, Tensor], pixels: Tensor) -> list[Tensor]:
    """The published network, layer by layer from its state dictionary; ReLUs in place, as torchvision has them."""
    f = nn.functional
    convolutions = [int(k.split(".")[1]) for k in state if k.startswith("encoder") and k.endswith("weight")]
    taps, x = [], pixels
    for number in range(29):
        if number in convolutions:
            x = f.conv2d(x, state[f"encoder.{number}.weight"], state[f"encoder.{number}.bias"], padding=1)
        elif number - 1 in convolutions:
            x = f.relu_(x)
        else:
            x = f.max_pool2d(x, 2)
        if number in (2, 14, 28):
            taps.append(x)
    adapted = []
    for number, x in enumerate(taps):
        s = {k.removeprefix(f"adaptation_layers.adap_layer_{number}."): v for k, v in state.items()}
        x = f.conv2d(f.conv2d(x, s["0.weight"], s["0.bias"]).relu(), s["2.weight"], s["2.bias"], padding=2)
        norm = (s["3.running_mean"], s["3.running_var"], s["3.weight"], s["3.bias"])
        adapted.append(f.batch_norm(x, *norm, eps=1e-5))
    return adapted


def s2dnet_state() -> dict[str, Tensor]:
    """Random weights in the layout of the published file."""
    g = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {}
    channels = 3
    widths = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256}
    widths |= dict.fromkeys((17, 19, 21, 24, 26, 28), 512)
    for number, width in widths.items():
        scale = (2 / (9 * channels)) ** 0.5
        state[f"encoder.{number}.weight"] = scale * torch.randn(width, channels, 3, 3, generator=g)
        state[f"encoder.{number}.bias"] = 0.1 * torch.randn(width, generator=g)
        channels = width
    for number, width in enumerate((64, 256, 512)):
        name = f"adaptation_layers.adap_layer_{number}"
        state[f"{name}.0.weight"] = torch.randn(64, width, 1, 1, generator=g) / width**0.5
        state[f"{name}.0.bias"] = 0.1 * torch.randn(64, generator=g)
        state[f"{name}.2.weight"] = torch.randn(128, 64, 5, 5, generator=g) / 40
        state[f"{name}.2.bias"] = 0.1 * torch.randn(128, generator=g)
        for part in ("weight", "bias", "running_mean", "running_var"):
            state[f"{name}.3.{part}"] = torch.rand(128, generator=g) + 0.5
        state[f"{name}.3.num_batches_tracked"] = torch.tensor(5)
    return state


@pytest.mark.parametrize("counted", [True, False])
def test_s2dnet_file_gives_the_networks_maps(counted: bool, tmp_path) -> None:
    state = s2dnet_state()
    kept = {k: v for k, v in state.items() if counted or not k.endswith("num_batches_tracked")}
    checkpoint = {"state_dict": kept, "hypercolumn_layers": ["conv1_2", "conv3_3", "conv5_3"]}
    torch.save(checkpoint, tmp_path / "s2dnet_weights.pth")
    images = torch.rand(1, 3, 56, 56)
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    std = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    pixels = (nn.functional.interpolate(images, (64, 64), mode="bilinear") - mean) / std
    maps = reference_s2dnet(state, pixels)
    every = S2DNet(["conv1_2", "conv3_3", "conv5_3"], weights=tmp_path / "s2dnet_weights.pth")
    last = S2DNet(weights=tmp_path / "s2dnet_weights.pth")
    with torch.no_grad():
        fine, middle, coarse = every(images).patches.chunk(3, dim=1)
        torch.testing.assert_close(last(images).patches, maps[2], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(coarse, maps[2], atol=1e-4, rtol=1e-4)
    # a patch's centre is where the four cells in its middle meet
    expected = nn.functional.avg_pool2d(maps[1][:, :, 1:, 1:], 2, stride=4)
    torch.testing.assert_close(middle, expected, atol=1e-4, rtol=1e-4)
    expected = nn.functional.avg_pool2d(maps[0][:, :, 7:, 7:], 2, stride=16)
    torch.testing.assert_close(fine, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("extractor", "how"), [(LoftrBackbone, "kornia/loftr loftr_outdoor.ckpt"), (S2DNet, "s2dnet_weights.pth")]
)
def test_wrong_and_missing_files(extractor: type, how: str, tmp_path) -> None:
    path = tmp_path / "weights.pth"
    with pytest.raises(WeightsNotFoundError, match=f"(?s)no weights at .*{how}"):
        extractor(weights=path)
    torch.save({"state_dict": {"head.weight": torch.zeros(3)}}, path)
    with pytest.raises(ValueError, match=f"(?s)do not fit: missing .*it holds .'head.weight'.*{how}"):
        extractor(weights=path)
    state = s2dnet_state() if extractor is S2DNet else loftr_checkpoint("")[1]["state_dict"]
    name = next(iter(state))
    state[name] = state[name][:5]
    torch.save({"state_dict": state}, path)
    with pytest.raises(ValueError, match=r"of the wrong shape .'(encoder\.0|conv1)\.weight"):
        extractor(weights=path)
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match="no state dictionary but a list"):
        extractor(weights=path)
    path.write_text("not a checkpoint")
    with pytest.raises(ValueError, match=r"torch\.load"):
        extractor(weights=path)

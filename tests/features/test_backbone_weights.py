"""Loading of published weights' layouts, on small models written to local folders and files."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from foundpose.features import (
    Clip,
    DinoV2,
    DinoV3,
    Sam,
    VisionTransformer,
    WeightsNotFoundError,
)
from foundpose.features.vision_transformer import CLIP_MEAN, CLIP_STD
from tests.features.backbones import CLIP, DINOV3, SAM, make, shake

TINY_DINOV2 = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2}


@pytest.fixture
def images(generator) -> Tensor:
    return torch.rand(2, 3, 28, 28, generator=generator)


@pytest.fixture
def hub_cache(monkeypatch, tmp_path) -> Path:
    """What HF_HUB_OFFLINE=1 and HF_HOME do: no network, and an empty cache at the path returned."""
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    return tmp_path


def cached(hub_cache: Path, repository: str) -> Path:
    """Where the hub's cache keeps a repository's files."""
    folder = hub_cache / f"models--{repository.replace('/', '--')}"
    (folder / "refs").mkdir(parents=True)
    (folder / "refs" / "main").write_text("0" * 40)
    return folder / "snapshots" / ("0" * 40)


def whole_clip(folder: Path) -> nn.Module:
    """A small CLIP with both encoders, as the hub's checkpoints are, written to a folder."""
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(0)
    text = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    vision = {**CLIP, "image_size": 224, "patch_size": 14}
    model = CLIPModel(CLIPConfig(text_config={**text, "vocab_size": 50}, vision_config=vision)).eval()
    model.save_pretrained(folder)
    return model


def whole_sam(folder: Path) -> nn.Module:
    """A small SAM with its mask decoder, as the hub's checkpoints are, written to a folder."""
    from transformers import SamConfig, SamModel

    torch.manual_seed(0)
    model = SamModel(SamConfig(vision_config={**SAM, "initializer_range": 0.2})).eval()
    model.save_pretrained(folder)
    return model


def test_clip_is_read_from_the_whole_model_in_the_hubs_cache(hub_cache, images) -> None:
    model = whole_clip(cached(hub_cache, "openai/clip-vit-large-patch14"))
    extractor = Clip(layer=2, config=CLIP)
    mean, std = (torch.tensor(x)[:, None, None] for x in (CLIP_MEAN, CLIP_STD))
    with torch.no_grad():
        states = model.vision_model(
            (images - mean) / std, interpolate_pos_encoding=True, output_hidden_states=True
        ).hidden_states
        torch.testing.assert_close(extractor(images).cls, states[3][:, 0], atol=1e-5, rtol=1e-4)


def test_sam_is_read_from_the_whole_model_in_the_hubs_cache(hub_cache, images) -> None:
    model = whole_sam(cached(hub_cache, "facebook/sam-vit-large"))
    extractor = Sam(layer=3, config=SAM)
    own = extractor.model.state_dict()
    theirs = model.vision_encoder.state_dict()
    read = {name.removeprefix("vision_encoder."): value for name, value in own.items()}
    assert set(theirs) - set(read) == {name for name in theirs if name.startswith("neck")}
    assert all(torch.equal(theirs[name], value) for name, value in read.items())


def test_dinov3_is_read_from_the_hubs_cache_and_its_older_key_names(hub_cache, images) -> None:
    from safetensors.torch import load_file, save_file

    folder = cached(hub_cache, "facebook/dinov3-vitl16-pretrain-lvd1689m")
    reference = shake(make("dinov3", layer=3))
    reference.model.save_pretrained(folder)
    (file,) = folder.glob("*.safetensors")
    # the published files begin with "layer.0", whatever a version of transformers calls the blocks
    state = {name.removeprefix("model."): value for name, value in load_file(file).items()}
    assert "layer.0.attention.q_proj.weight" in state
    save_file(state, file, metadata={"format": "pt"})
    with torch.no_grad():
        assert torch.equal(DinoV3(layer=3, config=DINOV3)(images).patches, reference(images).patches)


@pytest.mark.parametrize(
    ("construct", "repository"),
    [
        (lambda: DinoV3("vits16", 9), "facebook/dinov3-vits16-pretrain-lvd1689m"),
        (lambda: DinoV3("vit7b16", 9), "facebook/dinov3-vit7b16-pretrain-lvd1689m"),
        (lambda: Clip("vitl14_336"), "openai/clip-vit-large-patch14-336"),
        (lambda: Sam("vith"), "facebook/sam-vit-huge"),
    ],
)
def test_no_network_says_how_to_get_weights(construct, repository: str, hub_cache) -> None:
    with pytest.raises(WeightsNotFoundError, match=f"hf download {repository} ") as error:
        construct()
    assert ("accept the licence" in str(error.value)) == ("dinov3" in repository)


@pytest.mark.parametrize("extractor", [DinoV3, Clip, Sam])
def test_folders_without_weights(extractor: type, tmp_path) -> None:
    with pytest.raises(WeightsNotFoundError, match="hf download"):
        extractor(weights="folder/nothing")  # reads like a repository, but nobody asked for the hub
    with pytest.raises(WeightsNotFoundError, match="hf download"):
        extractor(weights=tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(ValueError, match="holds a 'bert' model"):
        extractor(weights=tmp_path)


def test_folder_with_a_configuration_only(tmp_path) -> None:
    make("dinov3", layer=3).model.config.save_pretrained(tmp_path)
    with pytest.raises(WeightsNotFoundError, match="hf download"):
        make("dinov3", None, tmp_path)


def test_folders_of_other_models_are_refused(tmp_path) -> None:
    make("dinov3", layer=3).model.save_pretrained(tmp_path / "dinov3")
    whole_clip(tmp_path / "clip")
    whole_sam(tmp_path / "sam")
    DinoV2("vits14", 0, config=TINY_DINOV2, weights="random", seed=0).model.save_pretrained(
        tmp_path / "dinov2"
    )
    with pytest.raises(ValueError, match="holds a 'dinov2' model, but variant vitl16 is 'dinov3_vit'"):
        DinoV3(weights=tmp_path / "dinov2")
    with pytest.raises(ValueError, match="holds a 'clip' model, but variant vitl is 'sam_vision_model'"):
        Sam(weights=tmp_path / "clip")
    with pytest.raises(ValueError, match="holds a 'sam' model, but variant vitl14 is 'clip_vision_model'"):
        Clip(weights=tmp_path / "sam")


def test_weights_of_another_variant_are_refused(tmp_path) -> None:
    make("dinov3", layer=3).model.save_pretrained(tmp_path / "dinov3")
    with pytest.raises(ValueError, match=r"hidden_size 32 instead of 1024.*vits16plus"):
        DinoV3(weights=tmp_path / "dinov3")
    with pytest.raises(ValueError, match="use_gated_mlp False instead of True"):
        DinoV3("vith16plus", 1, weights=tmp_path / "dinov3", config=DINOV3)
    whole_clip(tmp_path / "clip")
    with pytest.raises(ValueError, match="image_size 224 instead of 336"):
        Clip("vitl14_336", 1, weights=tmp_path / "clip", config=CLIP)
    with pytest.raises(ValueError, match="hidden_act quick_gelu instead of gelu"):
        Clip("vitl14", 1, weights=tmp_path / "clip", config={**CLIP, "hidden_act": "gelu"})
    whole_sam(tmp_path / "sam")
    with pytest.raises(ValueError, match=r"global_attn_indexes \(1, 3\) instead of \(2,\)"):
        Sam(layer=1, weights=tmp_path / "sam", config={**SAM, "global_attn_indexes": [2]})


def test_incomplete_folder_is_refused(tmp_path) -> None:
    from safetensors.torch import load_file, save_file

    make("dinov3", layer=3).model.save_pretrained(tmp_path)
    (file,) = tmp_path.glob("*.safetensors")
    state = {n: v for n, v in load_file(file).items() if "layer.1.attention.q_proj" not in n}
    save_file(state, file, metadata={"format": "pt"})
    with pytest.raises(ValueError, match=r"incomplete.*q_proj"):
        make("dinov3", None, tmp_path, layer=2)
    make("dinov3", None, tmp_path, layer=0)  # does not need block 1


@pytest.mark.parametrize(
    ("family", "variant", "millions"),
    [
        # as published: 21 M, 29 M, 86 M, 300 M, 840 M, 6716 M
        (DinoV3, "vits16", 21.6),
        (DinoV3, "vits16plus", 28.7),
        (DinoV3, "vitb16", 85.7),
        (DinoV3, "vitl16", 303.1),
        (DinoV3, "vith16plus", 840.6),
        (DinoV3, "vit7b16", 6716.0),
        # image encoders, without the projection to the text's space; of SAM 91 M, 308 M, 636 M
        (Clip, "vitb32", 87.5),
        (Clip, "vitb16", 85.8),
        (Clip, "vitl14", 303.2),
        (Clip, "vitl14_336", 303.5),
        (Sam, "vitb", 89.7),
        (Sam, "vitl", 308.3),
        (Sam, "vith", 637.0),
    ],
)
def test_variants_have_the_published_sizes(
    family: type[VisionTransformer], variant: str, millions: float
) -> None:
    from transformers import AutoModel

    sizes = family.variants[variant]
    with torch.device("meta"):
        model = AutoModel.from_config(family.build_config(sizes, sizes["num_hidden_layers"]))
    assert sum(p.numel() for p in model.parameters()) / 1e6 == pytest.approx(millions, rel=2e-3)

import pytest
import torch
from transformers import AutoModel

from foundpose.features.dinov2 import DinoV2
from foundpose.features.dinov2_checkpoints import VARIANTS, original_checkpoint_url
from foundpose.features.weights import WeightsNotFoundError
from tests.features import original_dinov2

SIZES = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 4, "image_size": 70}
VARIANT_NAMES = ["vits14", "vits14_reg", "vitg14", "vitg14_reg"]


def original_state(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    return original_dinov2.random_state(
        width=32, depth=4, grid=5, registers=4 * variant.endswith("_reg"), swiglu="vitg" in variant, seed=seed
    )


@pytest.mark.parametrize("variant", VARIANT_NAMES)
@pytest.mark.parametrize(
    ("layer", "final_norm", "size"), [(3, True, 70), (1, True, 56), (1, False, 56), (2, True, 98)]
)
def test_original_checkpoint_gives_the_original_tokens(tmp_path, variant, layer, final_norm, size) -> None:
    state = original_state(variant)
    torch.save(state, tmp_path / "original.pth")
    extractor = DinoV2(variant, layer, final_norm, weights=tmp_path / "original.pth", config=SIZES)
    images = torch.rand(2, 3, size, size, generator=torch.Generator().manual_seed(1))
    patches, cls = original_dinov2.forward(state, images, heads=4, last_block=layer, final_norm=final_norm)
    found = extractor(images)
    # tokens are of the order of 1 to 5, so this is a few units of float32 rounding
    assert (found.patches - patches).abs().max() < 1e-5 * patches.abs().max()
    assert (found.cls - cls).abs().max() < 1e-5 * cls.abs().max()


def test_reference_notices_a_wrong_conversion(tmp_path) -> None:
    """The comparison above would see queries and keys exchanged."""
    state = original_state("vits14")
    torch.save(state, tmp_path / "original.pth")
    extractor = DinoV2("vits14", 1, weights=tmp_path / "original.pth", config=SIZES)
    q, k, v = state["blocks.0.attn.qkv.weight"].chunk(3)
    state["blocks.0.attn.qkv.weight"] = torch.cat([k, q, v])
    images = torch.rand(1, 3, 70, 70)
    patches, _ = original_dinov2.forward(state, images, heads=4, last_block=1, final_norm=True)
    assert (extractor(images).patches - patches).abs().max() > 1e-2


@pytest.mark.parametrize("variant", VARIANT_NAMES)
def test_folder_of_transformers_gives_the_same_as_the_original(tmp_path, variant) -> None:
    torch.save(original_state(variant), tmp_path / "original.pth")
    whole = DinoV2(variant, 3, weights=tmp_path / "original.pth", config=SIZES)
    whole.model.save_pretrained(tmp_path / "folder")
    images = torch.rand(1, 3, 56, 56)
    for layer in (0, 2):
        a = DinoV2(variant, layer, weights=tmp_path / "original.pth", config=SIZES)
        b = DinoV2(variant, layer, weights=str(tmp_path / "folder"), config=SIZES)
        assert torch.equal(a(images).patches, b(images).patches)
        assert a.fingerprint() == b.fingerprint()


def test_missing_weights_say_how_to_get_them(tmp_path) -> None:
    with pytest.raises(WeightsNotFoundError) as error:
        DinoV2("vitl14_reg", weights=tmp_path / "nothing.pth")
    message = str(error.value)
    assert str(tmp_path / "nothing.pth") in message
    assert "hf download facebook/dinov2-with-registers-large" in message
    assert "dinov2_vitl14/dinov2_vitl14_reg4_pretrain.pth" in message


@pytest.fixture
def hub_cache(monkeypatch, tmp_path):
    """What HF_HUB_OFFLINE=1 and HF_HOME do: no network, and an empty cache at the path returned."""
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    return tmp_path


def test_no_network_says_how_to_get_weights(hub_cache) -> None:
    with pytest.raises(WeightsNotFoundError, match="hf download facebook/dinov2-small"):
        DinoV2("vits14", layer=9)


@pytest.mark.parametrize(
    ("variant", "repository"),
    [("vits14", "facebook--dinov2-small"), ("vitg14_reg", "facebook--dinov2-with-registers-giant")],
)
def test_hub_weights_are_read_from_its_cache(hub_cache, variant: str, repository: str) -> None:
    torch.save(original_state(variant), hub_cache / "original.pth")
    reference = DinoV2(variant, 3, weights=hub_cache / "original.pth", config=SIZES)
    folder = hub_cache / f"models--{repository}"
    reference.model.save_pretrained(folder / "snapshots" / ("0" * 40))
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("0" * 40)
    extractor = DinoV2(variant, 3, config=SIZES)
    images = torch.rand(1, 3, 56, 56)
    assert torch.equal(extractor(images).patches, reference(images).patches)


def test_folder_without_weights(tmp_path) -> None:
    DinoV2.build_config(VARIANTS["vits14"], 12).save_pretrained(tmp_path)
    with pytest.raises(WeightsNotFoundError, match="hf download facebook/dinov2-small"):
        DinoV2("vits14", layer=9, weights=tmp_path)


def test_weights_of_another_variant_are_refused(tmp_path) -> None:
    path = tmp_path / "original.pth"
    torch.save(original_state("vits14"), path)
    with pytest.raises(ValueError, match="num_register_tokens 0 instead of 4"):
        DinoV2("vits14_reg", 1, weights=path, config=SIZES)
    with pytest.raises(ValueError, match="hidden_size 32 instead of 384"):
        DinoV2("vits14", 1, weights=path)
    with pytest.raises(ValueError, match="use_swiglu_ffn"):
        DinoV2("vitg14", 1, weights=path, config=SIZES)
    folder = tmp_path / "folder"
    DinoV2("vits14", 3, weights=path, config=SIZES).model.save_pretrained(folder)
    with pytest.raises(ValueError, match="'dinov2' model"):
        DinoV2("vits14_reg", 1, weights=folder, config=SIZES)
    with pytest.raises(ValueError, match="num_attention_heads 4 instead of 2"):
        DinoV2("vits14", 1, weights=folder, config={**SIZES, "num_attention_heads": 2})


def test_incomplete_and_foreign_files_are_refused(tmp_path) -> None:
    path = tmp_path / "original.pth"
    state = original_state("vits14")
    del state["blocks.1.ls2.gamma"]
    torch.save(state, path)
    with pytest.raises(ValueError, match="incomplete"):
        DinoV2("vits14", 1, weights=path, config=SIZES)
    DinoV2("vits14", 0, weights=path, config=SIZES)  # does not need block 1
    torch.save({"teacher": {}}, path)
    with pytest.raises(ValueError, match=r"not an original DINOv2 backbone checkpoint.*teacher"):
        DinoV2("vits14", 1, weights=path, config=SIZES)
    path.write_text("not a checkpoint")
    with pytest.raises(ValueError, match=r"torch\.load"):
        DinoV2("vits14", 1, weights=path, config=SIZES)


@pytest.mark.parametrize(
    ("variant", "millions"),
    # sizes in the model card of DINOv2: 21 M, 86 M, 300 M, 1,100 M (rounded there)
    [("vits14", 22.1), ("vitb14", 86.6), ("vitl14", 304.4), ("vitg14", 1136.5)],
)
def test_variants_have_the_published_sizes(variant: str, millions: float) -> None:
    for name in (variant, f"{variant}_reg"):
        sizes = DinoV2.variants[name]
        with torch.device("meta"):
            model = AutoModel.from_config(DinoV2.build_config(sizes, sizes["num_hidden_layers"]))
        count = sum(p.numel() for p in model.parameters())
        assert count / 1e6 == pytest.approx(millions, rel=2e-3)


def test_addresses() -> None:
    assert DinoV2.hub_repository("vits14") == "facebook/dinov2-small"
    assert DinoV2.hub_repository("vitg14_reg") == "facebook/dinov2-with-registers-giant"
    assert original_checkpoint_url("vitb14").endswith("/dinov2_vitb14/dinov2_vitb14_pretrain.pth")

"""Fused attention, compilation, and that a batch is one pass."""

import copy
import pickle
import shutil

import pytest
import torch
import torch._inductor.config
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from foundpose.features import pretrained
from foundpose.features.pretrained import CompilationError
from foundpose.geometry import PerspectiveCrop, intrinsics_matrix
from tests.features.backbones import TRANSFORMERS, make
from tests.features.test_dinov2 import tiny

HAS_COMPILER = any(shutil.which(name) for name in ("g++", "clang++", "c++"))
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture
def images(generator) -> Tensor:
    return torch.rand(3, 3, 56, 56, generator=generator)


@pytest.mark.parametrize("name", ["dinov2", *TRANSFORMERS])
def test_fused_attention_runs_and_equals_the_formula(name: str, images, monkeypatch) -> None:
    extractor = tiny() if name == "dinov2" else make(name)
    with torch.no_grad():
        found = extractor(images).patches
    calls = []

    def formula(query, key, value, attn_mask=None, dropout_p=0.0, scale=None, is_causal=False, **options):
        assert dropout_p == 0.0
        assert not is_causal
        calls.append(query.shape)
        scores = query @ key.transpose(-2, -1) * (query.shape[-1] ** -0.5 if scale is None else scale)
        return torch.softmax(scores if attn_mask is None else scores + attn_mask, dim=-1) @ value

    monkeypatch.setattr(nn.functional, "scaled_dot_product_attention", formula)
    with torch.no_grad():
        expected = extractor(images).patches
    assert len(calls) == {"dinov2": 4}.get(name, 3)  # layers 3 and 2, counted from 0
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=2e-5)


@pytest.mark.gpu
def test_attention_is_fused_on_a_gpu() -> None:
    """Without the kernel that writes out all products there is still one that serves, in every precision."""
    images = torch.rand(2, 3, 420, 420, device="cuda")
    for precision in (None, "bf16", "fp16"):
        extractor = tiny(precision=precision, variant="vits14_reg").cuda()
        with torch.no_grad(), sdpa_kernel([SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION]):
            assert torch.isfinite(extractor(images).patches).all()


@pytest.mark.parametrize(("at_once", "expected"), [(None, [5]), (2, [2, 2, 1])])
def test_crops_of_several_images_are_one_pass(at_once, expected, generator, monkeypatch) -> None:
    """But for those that would not fit a CPU's cache together."""
    if at_once is not None:
        monkeypatch.setattr(pretrained, "CPU_PIXELS", at_once * 56**2)
    pictures = torch.rand(2, 3, 60, 80, generator=generator)
    K = intrinsics_matrix(90.0, 90.0, 39.5, 29.5).float().expand(2, 3, 3)
    masks = torch.zeros(5, 60, 80, dtype=torch.bool)
    for i in range(5):
        masks[i, 10 + 4 * i : 30 + 4 * i, 8 * i : 30 + 8 * i] = True
    crops = PerspectiveCrop(56)(pictures, K, masks, image_index=torch.tensor([0, 1, 0, 0, 1]))
    extractor = tiny()
    passes = []
    extractor.model.register_forward_pre_hook(
        lambda module, arguments, options: passes.append(len(options["pixel_values"])), with_kwargs=True
    )
    with torch.no_grad():
        together = extractor(crops.images)
    assert passes == expected
    with torch.no_grad():
        alone = [extractor(image[None]) for image in crops.images]
    for found, parts in zip(together, zip(*alone, strict=True), strict=True):
        torch.testing.assert_close(found, torch.cat(parts), atol=1e-5, rtol=1e-5)


@pytest.mark.skipif(not HAS_COMPILER, reason="needs a C++ compiler")
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.slow
def test_compiled_network_equals_the_network(device: str, images) -> None:
    plain, compiled = (tiny(layer=0, compile=compile).to(device) for compile in (False, True))
    with torch.no_grad():
        found, expected = compiled(images.to(device)), plain(images.to(device))
    torch.testing.assert_close(found.patches, expected.patches, atol=2e-5, rtol=2e-5)
    torch.testing.assert_close(found.cls, expected.cls, atol=2e-5, rtol=2e-5)
    assert compiled.fingerprint() == plain.fingerprint()
    assert list(compiled.state_dict()) == list(plain.state_dict())


@pytest.fixture
def compilations(monkeypatch) -> list[tuple[int, ...]]:
    """Shapes of the pictures for which graphs are made; the graphs run as they are, so no compiler is needed."""
    shapes = []
    compile_ = torch.compile

    def backend(graph, inputs):
        shapes.extend(x.shape for x in inputs if isinstance(x, Tensor) and x.shape[1:] == (3, 56, 56))
        return graph.forward

    def compile_graph(function, **options):
        assert options == {"dynamic": False}
        return compile_(function, backend=backend, **options)

    monkeypatch.setattr(torch, "compile", compile_graph)
    torch.compiler.reset()
    return shapes


def test_compiles_once_for_each_number_of_images(images, compilations) -> None:
    plain, compiled = tiny(layer=0), tiny(layer=0, compile=True)
    with torch.no_grad():
        for count in (3, 2, 3, 2):
            torch.testing.assert_close(compiled(images[:count]).patches, plain(images[:count]).patches)
    assert [shape[0] for shape in compilations] == [3, 2]


def test_a_copy_does_not_run_what_was_compiled_for_others(images, compilations) -> None:
    compiled = tiny(layer=0, compile=True)
    with torch.no_grad():
        expected = compiled(images).patches
        for other in (copy.deepcopy(compiled), pickle.loads(pickle.dumps(compiled))):
            for parameter in other.parameters():
                parameter.zero_()
            assert not other(images).patches.any()
            assert torch.equal(compiled(images).patches, expected)


def test_gradients_through_a_compiled_network(images, compilations) -> None:
    gradients = []
    for extractor in (tiny(layer=0), tiny(layer=0, compile=True)):
        x = images[:1].clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(extractor(x).patches.sin().sum(), x)
        gradients.append(gradient)
    assert compilations
    torch.testing.assert_close(gradients[0], gradients[1])


def test_no_compiler_is_a_clear_error(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch.compiler.reset()
    there_is_none = torch._inductor.config.patch({"cpp.cxx": (str(tmp_path / "none"),)})
    with (
        there_is_none,
        torch.no_grad(),
        pytest.raises(CompilationError, match=r"torch\.compile failed") as error,
    ):
        tiny(layer=0, compile=True)(torch.rand(1, 3, 28, 28))
    assert "compile=false" in str(error.value)
    assert issubclass(CompilationError, ValueError)

import copy
import pickle
from pathlib import Path

import pytest
import torch

import foundpose.features.precision as precision_module
from foundpose.features import AdaptedExtractor, PatchNoise
from foundpose.features.precision import (
    autocast_dtype,
    autocast_precision,
    cpu_instructions,
    has_fast_bfloat16,
    quantize_linear_layers,
)
from tests.features.test_dinov2 import tiny

CPU = torch.device("cpu")


@pytest.fixture
def images(generator) -> torch.Tensor:
    return torch.rand(3, 3, 56, 56, generator=generator)


@pytest.fixture(params=[True, False], ids=["with bf16", "without bf16"])
def fast(request, monkeypatch) -> bool:
    """Whether the CPU is taken to have bfloat16 instructions."""
    instructions = {"avx2", "avx512_bf16"} if request.param else {"avx2"}
    monkeypatch.setattr(precision_module, "cpu_instructions", lambda: instructions)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    return request.param


def test_auto_is_what_the_cpu_has_instructions_for(images, fast) -> None:
    exact, rounded, auto = tiny(), tiny(precision="bf16"), tiny(precision="auto")
    with torch.no_grad():
        expected = (rounded if fast else exact)(images)
        found = auto(images)
    assert torch.equal(found.patches, expected.patches)
    assert torch.equal(found.cls, expected.cls)
    assert found.patches.dtype == torch.float32
    assert auto.running_precision() == ("bf16" if fast else None)
    assert auto.fingerprint() == exact.fingerprint()


def test_auto_leaves_gradients_exact(images, fast) -> None:
    exact, auto = tiny(), tiny(precision="auto")
    gradients = []
    for extractor in (exact, auto):
        x = images.clone().requires_grad_(True)
        out = extractor(x).patches
        (gradient,) = torch.autograd.grad(out.square().sum(), x)
        gradients.append((out.detach(), gradient))
    assert torch.equal(gradients[0][0], gradients[1][0])
    assert torch.equal(gradients[0][1], gradients[1][1])


def test_what_was_asked_for_is_what_runs(monkeypatch) -> None:
    for name, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        assert autocast_dtype(name, CPU) == dtype
        assert autocast_precision(name, CPU) == name
    assert autocast_dtype(None, CPU) is None
    with torch.no_grad():
        assert autocast_dtype("auto", torch.device("meta")) is None
    for capability, expected in (((6, 1), None), ((7, 5), "fp16"), ((8, 0), "bf16"), ((9, 0), "bf16")):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device, c=capability: c)
        assert autocast_precision("auto", torch.device("cuda")) == expected


def linear_by_hand(x: torch.Tensor, layer: torch.nn.Linear) -> torch.Tensor:
    """Dynamic quantisation, from its definition: inputs on 7 bits from least to most, weights on 8 around zero."""
    low, high = min(float(x.min()), 0.0), max(float(x.max()), 0.0)
    step = (high - low) / 127
    zero = round(-low / step)
    inputs = ((x / step).round() + zero).clamp(0, 127) - zero
    weight_step = max(-float(layer.weight.min()) / 128, float(layer.weight.max()) / 127, 1e-9)
    weights = (layer.weight / weight_step).round().clamp(-128, 127)
    return (inputs @ weights.T) * (step * weight_step) + layer.bias


def test_linear_layers_multiply_integers(generator) -> None:
    model = torch.nn.Sequential(torch.nn.Linear(40, 24))
    x = torch.randn(50, 40, generator=generator)
    quantized = copy.deepcopy(model)
    quantize_linear_layers(quantized)
    with torch.no_grad():
        found, expected, exact = quantized(x), linear_by_hand(x, model[0]), model(x)
    rounding = (expected - exact).norm()
    assert 0.002 < rounding / exact.norm() < 0.03
    assert (found - expected).norm() < 0.5 * rounding


def test_int8_is_for_inference_and_leaves_the_weights(images) -> None:
    exact, rounded, calls = tiny(), tiny(precision="int8"), []
    rounded.register_forward_hook(lambda *_: calls.append(None))
    with torch.no_grad():
        found, expected = rounded(images), exact(images)
        alone = [rounded(image[None]).patches for image in images]
    assert len(calls) == 1 + len(images)
    assert torch.equal(found.patches, torch.cat(alone))  # no image changes another's scales
    for one, other in zip(found, expected, strict=True):
        assert not torch.equal(one, other)
        assert (one - other).norm() < 0.1 * other.norm()
    assert torch.equal(rounded(images).patches, exact(images).patches)  # where a gradient may be asked for
    assert rounded.running_precision() == "int8"
    assert rounded.fingerprint() == exact.fingerprint()
    assert list(rounded.state_dict()) == list(exact.state_dict())
    rounded._forward_hooks.clear()
    copied = pickle.loads(pickle.dumps(rounded))
    with torch.no_grad():
        assert torch.equal(copied(images).patches, found.patches)
        for weight in copied.model.parameters():
            weight.mul_(0.5)  # as an optimiser does
        changed = tiny(precision="int8")
        changed.model.load_state_dict(copied.model.state_dict())
        assert torch.equal(copied(images).patches, changed(images).patches)
        assert not torch.equal(copied(images).patches, found.patches)


def test_int8_is_refused_where_it_cannot_be(images) -> None:
    with pytest.raises(ValueError, match="'int8' cannot be compiled; set compile=false"):
        tiny(precision="int8", compile=True)
    with pytest.raises(ValueError, match="'int8' is for CPUs, the network is on meta"), torch.no_grad():
        tiny(precision="int8").to("meta")(images)


def test_extractors_around_another_run_in_its_precision() -> None:
    inner = tiny(precision="bf16")
    assert AdaptedExtractor(inner).running_precision() == "bf16"
    assert PatchNoise(inner, 0.5).running_precision() == "bf16"
    assert AdaptedExtractor(tiny()).running_precision() is None


def test_instructions_are_those_that_linux_tells(monkeypatch) -> None:
    if not (Path("/proc/cpuinfo").is_file() and hasattr(torch.cpu, "get_capabilities")):
        pytest.skip("needs Linux and a torch that tells")
    by_linux = Path("/proc/cpuinfo").read_text().split()
    for name in ("avx2", "avx512_bf16", "amx_bf16"):
        assert (name in cpu_instructions()) == (name in by_linux)
    for capabilities, expected in (
        ({"avx2": True, "avx512_bf16": True}, True),
        ({"avx2": True, "avx512_bf16": False}, False),
    ):
        monkeypatch.setattr(torch.cpu, "get_capabilities", capabilities.copy)
        assert has_fast_bfloat16(CPU) == (expected and torch.backends.mkldnn.is_available())
    assert not has_fast_bfloat16(torch.device("meta"))
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert cpu_instructions() == set()


@pytest.mark.gpu
def test_auto_on_a_gpu(images) -> None:
    exact, auto = tiny().cuda(), tiny(precision="auto").cuda()
    with torch.no_grad():
        found, expected = auto(images.cuda()), exact(images.cuda())
    assert auto.running_precision() in ("bf16", "fp16")
    assert not torch.equal(found.patches, expected.patches)
    similarity = torch.nn.functional.cosine_similarity(found.patches, expected.patches, dim=1)
    assert similarity.min() > 0.999

import ctypes
import sys
from types import SimpleNamespace

import pytest
import torch

import foundpose.utils.batch_size as batch_size_module
from foundpose.features import PcaProjection
from foundpose.utils.batch_size import check_batch_size, free_memory, measure_batch_size, peak_memory
from tests.onboarding.jobs import small_onboarder

CPU = torch.device("cpu")
MIB = 2**20
linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux")
DEVICES = [
    pytest.param("cpu", marks=linux),
    pytest.param("cuda", marks=pytest.mark.gpu),
]


@pytest.mark.parametrize("device", DEVICES)
def test_peak_memory_is_what_a_run_allocates(device):
    def run(samples):
        torch.ones(samples * 40 * MIB, dtype=torch.uint8, device=device)

    run(1)
    if device == "cpu":
        # Memory that other tests have freed, but the allocator holds, would be used without the process growing.
        ctypes.CDLL(None).malloc_trim(0)
    for samples in (1, 3):
        assert peak_memory(run, samples, torch.device(device)) / MIB == pytest.approx(40 * samples, abs=10)
    assert peak_memory(lambda _: None, 1, torch.device(device)) < 10 * MIB


@pytest.mark.gpu
def test_free_memory_of_a_gpu_counts_what_torch_could_give_back():
    device = torch.device("cuda")
    before = free_memory(device)
    held = torch.ones(300 * MIB, dtype=torch.uint8, device=device)
    assert before - free_memory(device) == pytest.approx(300 * MIB, abs=30 * MIB)
    del held  # kept by the allocator
    assert free_memory(device) == pytest.approx(before, abs=30 * MIB)


@pytest.mark.parametrize(
    ("fixed", "each", "free", "processes", "expected"),
    [
        (0, 100, 1000, 1, 4),  # seven fit into 70 %
        (0, 100, 1200, 1, 8),
        (0, 100, 1200, 2, 4),
        (500, 100, 1200, 1, 2),  # three fit beside what any batch takes
        (0, 100, 100, 1, 1),
        (0, 100, 100_000, 1, 16),
        (1000, 0, 100_000, 1, 16),  # no growth seen
    ],
)
def test_a_linear_model_of_the_memory(monkeypatch, fixed, each, free, processes, expected):
    tried = []

    def peak(run, samples, device):
        run(samples)
        return (fixed + each * samples) * MIB

    monkeypatch.setattr(batch_size_module, "peak_memory", peak)
    monkeypatch.setattr(batch_size_module, "free_memory", lambda device: free * MIB)
    assert measure_batch_size(tried.append, CPU, processes) == expected
    assert tried == [1, 1, 2]
    assert measure_batch_size(tried.append, CPU, processes, samples=3) == min(expected, 2)


@linux
def test_free_memory_and_limits_of_control_groups_count(monkeypatch, tmp_path):
    available = SimpleNamespace(available=200 * MIB)
    monkeypatch.setattr(batch_size_module.psutil, "virtual_memory", lambda: available)
    (tmp_path / "job" / "step").mkdir(parents=True)
    (tmp_path / "cgroup").write_text("12:cpuset:/\n0::/job/step\n")
    (tmp_path / "job" / "step" / "memory.max").write_text("max\n")
    (tmp_path / "job" / "memory.max").write_text(f"{50 * MIB}\n")
    (tmp_path / "job" / "memory.current").write_text(f"{20 * MIB}\n")
    monkeypatch.setattr(batch_size_module, "_CGROUPS", tmp_path)
    monkeypatch.setattr(batch_size_module, "_CGROUP", tmp_path / "cgroup")
    assert free_memory(CPU) == 30 * MIB
    monkeypatch.setattr(batch_size_module, "_CGROUP", tmp_path / "none")
    assert free_memory(CPU) == 200 * MIB


def test_bad_sizes_and_devices():
    for good in (1, 16, "auto"):
        check_batch_size(good)
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        check_batch_size(0)
    with pytest.raises(ValueError, match="a whole number or 'auto', got 'large'"):
        check_batch_size("large")
    with pytest.raises(ValueError, match="give a number on this meta"):
        measure_batch_size(lambda _: None, torch.device("meta"))


@pytest.mark.parametrize("device", DEVICES)
def test_an_onboarder_finds_its_batch_size_once(device, blob, monkeypatch):
    onboarder = small_onboarder(batch_size="auto").to(device)
    described = []
    onboarder.extractor.register_forward_pre_hook(lambda _, images: described.append(len(images[0])))
    size = onboarder.batch_size
    assert described == [1, 1, 2]
    assert onboarder.batch_size == size
    assert len(described) == 3
    assert size & (size - 1) == 0
    assert 1 <= size <= 64
    representation = onboarder(blob, "blob")
    assert max(described[3:]) == min(size, 10)
    assert "batch_size" not in onboarder.settings()
    fixed = small_onboarder(batch_size=size).to(device)(blob, "blob")
    assert torch.equal(representation.descriptors, fixed.descriptors)
    # With little memory the batches are small.
    monkeypatch.setattr(batch_size_module, "free_memory", lambda device: 0)
    onboarder.batch_size = "auto"
    assert onboarder.batch_size == 1
    with pytest.raises(ValueError, match="must be at least 1, got -1"):
        small_onboarder(batch_size=-1, projection=PcaProjection(16))

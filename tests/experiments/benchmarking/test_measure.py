import os
import subprocess

import numpy as np
import pytest
import torch

from benchmarking import MeasureSettings
from benchmarking.hardware import describe_hardware, describe_versions, git_commit
from benchmarking.measure import PeakMemory, count_host_syncs, measure
from benchmarking.tasks import Task, run_tasks

CPU = torch.device("cpu")
MIB = 2**20


class FakeClock:
    """Stands still but for what a call says that it took."""

    def __init__(self, durations):
        self.durations = iter(durations)
        self.now = 100.0
        self.calls = 0

    def __call__(self):
        return self.now

    def work(self):
        self.calls += 1
        self.now += next(self.durations)


def test_median_and_quartiles_leave_the_warmup_out():
    seconds = [0.3, 0.1, 0.2, 0.5, 0.4, 0.9, 0.05]
    clock = FakeClock([5.0, 4.0, *seconds])
    result = measure(clock.work, CPU, MeasureSettings(len(seconds), warmup=2, seconds=10.0), clock)
    assert result.calls == len(seconds)
    assert clock.calls == len(seconds) + 2
    expected = np.percentile(seconds, [50, 25, 75])
    assert np.allclose([result.median, result.lower, result.upper], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("durations", "warmup", "calls", "timed"),
    [
        ([1.0] * 9, 0, 5, 5),  # 5 s are over after five
        ([3.0] * 9, 0, 3, 3),  # at least three
        ([7.0] * 9, 3, 2, 1),  # one alone takes longer, and so did the first warm-up
        ([0.1] * 30, 2, 22, 20),  # all repeats
    ],
)
def test_time_limit(durations, warmup, calls, timed):
    clock = FakeClock(durations)
    result = measure(clock.work, CPU, MeasureSettings(20, warmup, seconds=5.0), clock)
    assert (clock.calls, result.calls) == (calls, timed)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"repeats": 0}, "repeats must be at least 1, got 0"),
        ({"warmup": -1}, "warmup must be at least 0, got -1"),
        ({"seconds": 0.0}, "seconds must be positive, got 0.0"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        MeasureSettings(**settings)


@pytest.mark.parametrize("warmup", [0, 1])
def test_peak_memory_of_a_call(warmup):
    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("the peak resident size can be reset on Linux only")

    def allocate():
        # A peak in the middle that is gone at the end, and again in every call.
        torch.ones(100 * MIB // 4)

    memory = measure(allocate, CPU, MeasureSettings(3, warmup, 1.0)).memory
    assert memory.rise == pytest.approx(100 * MIB, rel=0.05)
    assert memory.peak > memory.rise
    assert measure(lambda: None, CPU, MeasureSettings(3, warmup, 1.0)).memory.rise < 4 * MIB


def test_no_peak_memory_where_it_cannot_be_told(monkeypatch, tmp_path):
    monkeypatch.setattr("benchmarking.measure._RESET_PEAK", tmp_path / "none" / "clear_refs")
    with PeakMemory(CPU) as peak:
        pass
    assert peak.memory.rise is None
    assert "cannot be reset" in peak.memory.reason
    with PeakMemory(torch.device("mps")) as peak:
        pass
    assert peak.memory == (None, None, "not measured on mps")


@pytest.mark.gpu
def test_peak_memory_on_a_gpu():
    device = torch.device("cuda")
    kept = torch.ones(10 * MIB, device=device)
    memory = measure(lambda: torch.ones(25 * MIB, device=device), device, MeasureSettings(3, 1, 1.0)).memory
    assert memory.rise == pytest.approx(100 * MIB, rel=0.01)
    assert memory.peak >= memory.rise + kept.numel() * 4


@pytest.mark.gpu
def test_host_syncs_on_a_gpu():
    x = torch.ones(5, device="cuda")
    assert count_host_syncs(lambda: x + x) == 0
    assert count_host_syncs(lambda: (x.sum().item(), x.nonzero())) == 2


def test_tasks_run_in_inference_mode_unless_they_need_a_gradient():
    modes = []
    told = []
    tasks = [
        Task(
            "g", "plain", lambda: modes.append(torch.is_inference_mode_enabled()), 4, units=4, projected=100
        ),
        Task("g", "gradient", lambda: modes.append(torch.is_inference_mode_enabled()), gradient=True),
    ]
    settings = MeasureSettings(1, 0, 1.0)
    plain, gradient = run_tasks(tasks, CPU, settings, lambda *args: told.append(args))
    assert modes == [True, False]
    assert told == [("g", 0, 2), ("g", 1, 2), ("g", 2, 2)]
    assert plain.per_unit == pytest.approx(plain.median / 4)
    assert plain.projected == pytest.approx(plain.median * 25)
    assert gradient.projected is None
    assert run_tasks([], CPU, settings, lambda *args: told.append(args)) == []


def test_hardware_and_versions(tmp_path):
    hardware = describe_hardware(CPU)
    assert hardware["cpu"]
    assert 1 <= hardware["cores_available"] <= hardware["cores"]
    assert hardware["threads"] == torch.get_num_threads()
    assert hardware["ram_bytes"] > 2**28
    assert hardware["gpu"] is None
    versions = describe_versions()
    assert versions["torch"] == torch.__version__
    assert versions["numpy"] == np.__version__

    assert git_commit(tmp_path) is None
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", "-C", str(tmp_path)]
    (tmp_path / "file").write_text("1")
    for command in (["init", "-q"], ["add", "file"], ["commit", "-q", "-m", "one"]):
        subprocess.run([*git, *command], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    assert git_commit(tmp_path) == head.stdout.strip()
    (tmp_path / "file").write_text("2")
    assert git_commit(tmp_path) == head.stdout.strip() + "-dirty"

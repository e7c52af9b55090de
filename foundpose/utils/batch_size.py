"""How large a batch may be, from the memory that is free."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import psutil
import torch

BatchSize = int | Literal["auto"]

# Share of the free memory that a batch may take: allocators leave gaps, and other programs come and go.
_SAFETY = 0.7
_LIMITS = {"cuda": 64, "cpu": 16}
"""Beyond these, more samples at a time make none of them faster."""
_TRIALS = (1, 2)
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_CGROUP, _CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def check_batch_size(batch_size: BatchSize) -> None:
    """Raise ValueError unless it is "auto" or a whole number of at least 1."""
    if isinstance(batch_size, str):
        if batch_size != "auto":
            raise ValueError(f"batch_size must be a whole number or 'auto', got {batch_size!r}")
    elif batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")


def measure_batch_size(
    run: Callable[[int], object], device: torch.device, processes: int = 1, samples: int | None = None
) -> int:
    """Find out how many samples a device can take at a time.

    Peak memory is measured with one sample and with two; more are taken to need more in proportion. The answer is a
    power of two, so that small differences between measurements do not show, and at most 64 on a GPU and 16 on a CPU.

    Args:
        run: does the work with a number of samples.
        device: CUDA device or CPU.
        processes: how many processes share the device's free memory.
        samples: how many there are in all, if known: no batch is larger.

    Raises:
        ValueError: memory cannot be measured there.
    """
    if device.type not in _LIMITS or (device.type == "cpu" and not _RESET.exists()):
        raise ValueError(
            f"batch_size=auto needs a CUDA device, or a CPU under Linux; give a number on this {device.type}"
        )
    run(_TRIALS[0])  # what is allocated once and kept is not part of a batch
    one, two = (peak_memory(run, count, device) for count in _TRIALS)
    # A process's memory is seen in coarse steps, so growth of less than half of a sample's share is not believed.
    per_sample = max(two - one, two // 4, 1)
    fixed = max(one - per_sample, 0)
    room = _SAFETY * free_memory(device) / processes - fixed
    limit = _LIMITS[device.type] if samples is None else min(samples, _LIMITS[device.type])
    most = max(1, min(int(room / per_sample), limit))
    return 1 << (most.bit_length() - 1)


def peak_memory(run: Callable[[int], object], samples: int, device: torch.device) -> int:
    """Bytes by which a run raises the memory in use at its highest, of the GPU or of this process."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run(samples)
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    _RESET.write_text("5")  # sets the peak to what is resident now
    before = psutil.Process().memory_info().rss
    run(samples)
    # psutil has no peak that can be set back.
    peak = re.search(r"^VmHWM:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    assert peak is not None
    return max(1024 * int(peak.group(1)) - before, 0)


def free_memory(device: torch.device) -> int:
    """Bytes that this process could still take on a CUDA device or on the CPU, cgroup limits included."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return min([psutil.virtual_memory().available, *_room_in_cgroups()])


def _room_in_cgroups() -> list[int]:
    """Bytes that each of the control groups around this process (a container, a Slurm job) leaves.

    psutil knows of the whole machine alone, and a job that takes more than its group may have is killed.
    """
    found = re.search(r"^0::/(.*)$", _CGROUP.read_text() if _CGROUP.is_file() else "", re.MULTILINE)
    if found is None:
        return []
    own = _CGROUPS / found.group(1)
    rooms = []
    for group in (own, *own.parents):
        limit = group / "memory.max"
        if limit.is_file() and (most := limit.read_text().strip()) != "max":
            rooms.append(max(int(most) - int((group / "memory.current").read_text()), 0))
    return rooms

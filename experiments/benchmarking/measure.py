"""Time and memory of a call."""

import ctypes
import re
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import torch

_STATUS = Path("/proc/self/status")
_RESET_PEAK = Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class MeasureSettings:
    """How often a call is repeated.

    Args:
        repeats: calls that are timed at most.
        warmup: calls before them; a single one where that takes longer than ``seconds``.
        seconds: no further call once the timed ones have taken this long together (but at least three are made,
            unless one alone takes longer).

    Raises:
        ValueError: a number out of range.
    """

    repeats: int = 20
    warmup: int = 2
    seconds: float = 2.0

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ValueError(f"repeats must be at least 1, got {self.repeats}")
        if self.warmup < 0:
            raise ValueError(f"warmup must be at least 0, got {self.warmup}")
        if not self.seconds > 0:
            raise ValueError(f"seconds must be positive, got {self.seconds}")

    def once(self) -> "MeasureSettings":
        """For a call that is too long to be repeated."""
        return MeasureSettings(repeats=1, warmup=0, seconds=self.seconds)


class Memory(NamedTuple):
    """Peak memory of a call.

    Attributes:
        rise: bytes by which the peak exceeds what was in use before; None where it cannot be told.
        peak: bytes at the peak, all together.
        reason: why there is none.
    """

    rise: int | None
    peak: int | None
    reason: str | None = None


class Measurement(NamedTuple):
    """Seconds that a call took.

    Attributes:
        median: of the calls timed.
        lower: first quartile.
        upper: third quartile.
        calls: number of calls timed.
        memory: peak of one of the calls.
    """

    median: float
    lower: float
    upper: float
    calls: int
    memory: Memory


class PeakMemory:
    """Measures the peak memory of what runs inside it, as a context manager.

    On CUDA that is what PyTorch allocates on the device, on Linux without CUDA the resident size of the process.
    Its peak is reset first, and what the allocator holds back is returned to the system, else a second call would
    seem to need nothing.

    Args:
        device: where the work is done.

    Attributes:
        memory: what was measured, once the context is left.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.memory = Memory(None, None, f"not measured on {device.type}")
        self._before: int | None = None

    def __enter__(self) -> "PeakMemory":
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            torch.cuda.reset_peak_memory_stats(self.device)
            self._before = torch.cuda.memory_allocated(self.device)
        elif self.device.type == "cpu":
            try:
                return_free_memory()
                _RESET_PEAK.write_text("5")
                self._before = psutil.Process().memory_info().rss
            except OSError as error:
                self.memory = Memory(None, None, f"the peak resident size cannot be reset here ({error})")
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            return
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            peak = torch.cuda.max_memory_allocated(self.device)
        else:
            peak = _peak_resident()
        self.memory = Memory(max(peak - self._before, 0), peak)


def measure(
    call: Callable[[], object],
    device: torch.device,
    settings: MeasureSettings,
    clock: Callable[[], float] = time.perf_counter,
) -> Measurement:
    """Time a call.

    The memory is that of the last call of the warm-up, or of the first timed one without a warm-up.

    Args:
        call: what to run; its result is dropped.
        device: is synchronised before a clock is read.
        settings: how often.
        clock: seconds, for tests.
    """

    def timed() -> float:
        synchronize(device)
        start = clock()
        call()
        synchronize(device)
        return clock() - start

    memory: Memory | None = None
    seconds: list[float] = []
    for _ in range(settings.warmup):
        with PeakMemory(device) as peak:
            took = timed()
        memory = peak.memory
        if took > settings.seconds:
            break
    while len(seconds) < settings.repeats:
        if memory is None:
            with PeakMemory(device) as peak:
                seconds.append(timed())
            memory = peak.memory
        else:
            seconds.append(timed())
        if sum(seconds) >= settings.seconds and (len(seconds) >= 3 or seconds[0] >= settings.seconds):
            break
    assert memory is not None
    return Measurement(*quartiles(seconds), len(seconds), memory)


def count_host_syncs(call: Callable[[], object]) -> int:
    """How often a call makes the host wait for the GPU, by PyTorch's own account (it does not know all ways)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            call()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return sum("synchronizing CUDA operation" in str(warning.message) for warning in caught)


def quartiles(seconds: Sequence[float]) -> tuple[float, float, float]:
    """Median, first and third quartile, interpolated linearly."""
    lower, median, upper = np.quantile(np.asarray(seconds), [0.25, 0.5, 0.75]).tolist()
    return median, lower, upper


def synchronize(device: torch.device) -> None:
    """Wait until the device has nothing left to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def return_free_memory() -> None:
    """Have glibc's allocator give back what it does not use; other allocators are left alone."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _peak_resident() -> int:
    """Largest resident size since the peak was set back, which psutil does not know."""
    found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"{_STATUS} has no VmHWM")
    return 1024 * int(found[1])

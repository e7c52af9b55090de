"""What a benchmark ran on."""

import importlib.util
import os
import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

_PACKAGES = (
    *("foundpose", "torch", "kornia", "numpy", "transformers", "embreex"),
    *("opencv-python-headless", "opencv-python", "scikit-learn", "faiss-cpu", "scipy"),
)


def describe_hardware(device: torch.device) -> dict[str, Any]:
    """CPU model, cores, threads, memory in bytes, the GPU if the device is one, and how busy the machine is."""
    facts: dict[str, Any] = {
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "cores_available": _available_cores(),
        "threads": torch.get_num_threads(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "ram_bytes": _ram_bytes(),
        "device": str(device),
        "gpu": None,
    }
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        facts["gpu"] = properties.name
        facts["gpu_bytes"] = properties.total_memory
        facts["gpu_capability"] = f"{properties.major}.{properties.minor}"
    elif device.type == "mps":
        facts["gpu"] = "Apple GPU"
    return facts


def describe_versions() -> dict[str, str | None]:
    """Versions of Python, the packages that matter (those that are installed), CUDA, and the code's git commit."""
    facts: dict[str, str | None] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            continue
    facts["cuda"] = torch.version.cuda
    facts["commit"] = git_commit(Path(__file__).resolve().parent)
    return facts


def git_commit(folder: Path) -> str | None:
    """Commit of the working tree that holds a folder, with ``-dirty`` where files differ; None where unknown."""
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


def is_installed(module: str) -> bool:
    """Whether a module can be imported, without doing so."""
    return importlib.util.find_spec(module) is not None


def cpu_model() -> str:
    """The processor's name."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1].strip() if found else platform.processor() or platform.machine()


def _available_cores() -> int | None:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _ram_bytes() -> int | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None

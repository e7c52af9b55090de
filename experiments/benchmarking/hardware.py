"""What a benchmark ran on."""

import platform
import re
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil
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
        "cores": psutil.cpu_count(),
        "cores_available": len(psutil.Process().cpu_affinity()) if psutil.LINUX else psutil.cpu_count(),
        "threads": torch.get_num_threads(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "load_average": psutil.getloadavg()[0],
        "ram_bytes": psutil.virtual_memory().total,
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


def cpu_model() -> str:
    """The processor's name, which Linux tells in a file and other systems through Python."""
    found = None
    with suppress(OSError):
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return found[1].strip() if found else platform.processor() or platform.machine()

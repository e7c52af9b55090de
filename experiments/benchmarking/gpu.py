"""The parts of a check on a GPU, each in a process of its own: one that fails leaves the others alone."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from benchmarking.checks import Check
from benchmarking.hardware import describe_hardware, describe_versions
from benchmarking.inference import estimate
from benchmarking.measure import Measurement, MeasureSettings, measure
from benchmarking.report import check_table, write_report
from benchmarking.run import make_stages, prepare, run_benchmark, workload_sizes
from benchmarking.scripted import ScriptedExtractor
from benchmarking.workload import Workload, make_workload
from foundpose.config import build_method, load_config
from foundpose.geometry import pose_deviation
from foundpose.pipeline import FoundPose
from foundpose.synthetic import procedural_mesh
from foundpose.utils.files import write_json, write_text
from foundpose.utils.progress import ProgressBars

_PART_FILE = "part.json"


class Outcome(NamedTuple):
    """What became of a part.

    Attributes:
        name: of the part.
        status: "ran", or why it did not.
        seconds: it took.
        content: what it measured: ``checks``, and further figures.
    """

    name: str
    status: str
    seconds: float
    content: dict[str, Any]


def run_parts(cfg: DictConfig, app: Path, overrides: Sequence[str], folder: Path) -> list[Outcome]:
    """Run every part in a process, whatever becomes of the others.

    Args:
        cfg: ``conf/gpu_check.yaml``.
        app: the program that runs a part.
        overrides: of the configuration, for the processes.
        folder: each part's files go to ``parts/`` in it.

    Raises:
        ValueError: an unknown part.
    """
    known = _parts(cfg)
    unknown = [name for name in cfg.parts if not any(part.split()[0] == name for part in known)]
    if unknown:
        raise ValueError(
            f"parts must be among tests, benchmark, onboarding, dataset, agreement; got {unknown[0]!r}"
        )
    start, outcomes = time.monotonic(), []
    for name in known:
        if name.split()[0] not in cfg.parts:
            continue
        where = folder / "parts" / name.replace(" ", "-")
        limit = min(cfg.part_seconds, cfg.seconds - (time.monotonic() - start))
        print(f"{name} …", flush=True)
        begin = time.monotonic()
        command = [sys.executable, str(app), *overrides, f"part='{name}'", f"hydra.run.dir={where}"]
        status = _run(command, where, limit) if limit > 0 else "no time left"
        content = load_part(where) if status == "ran" else {}
        outcomes.append(Outcome(name, status, time.monotonic() - begin, content))
        print(f"{name}: {status}, {outcomes[-1].seconds:.0f} s", flush=True)
    return outcomes


def run_part(cfg: DictConfig, folder: Path) -> None:
    """Run one part in this process and write what it finds.

    Raises:
        ValueError: there is no such part.
    """
    parts = _parts(cfg)
    if cfg.part not in parts:
        raise ValueError(f"part must be one of {list(parts)}, got {cfg.part!r}")
    GlobalHydra.instance().clear()  # parts load configurations of their own
    write_json(folder / _PART_FILE, parts[cfg.part](cfg, folder))


def load_part(folder: Path) -> dict[str, Any]:
    """What a part has written."""
    return dict(json.loads((folder / _PART_FILE).read_text()))


def write_page(cfg: DictConfig, outcomes: Sequence[Outcome], folder: Path) -> tuple[str, bool]:
    """Write ``gpu_check.json`` and ``gpu_check.md``.

    Returns:
        The page, and whether all parts ran and all limits were kept.
    """
    checks = [
        Check(**check | {"name": f"{outcome.name}: {check['name']}"})
        for outcome in outcomes
        for check in outcome.content.get("checks", [])
    ]
    hardware, versions = describe_hardware(_existing(cfg.device)), describe_versions()
    passed = all(outcome.status == "ran" for outcome in outcomes) and all(check.passed for check in checks)
    lines = [
        f"- {outcome.name}: {outcome.status}, {outcome.seconds:.0f} s{_figures(outcome)}"
        for outcome in outcomes
    ]
    text = "\n".join(
        [
            "# GPU check\n",
            f"{hardware['gpu'] or hardware['cpu']}; torch {versions['torch']}, CUDA {versions['cuda']}, "
            f"foundpose {versions['foundpose']} ({(versions['commit'] or 'no commit')[:12]}).\n",
            check_table(checks) if checks else "Nothing was measured.\n",
            *lines,
            "",
        ]
    )
    write_json(
        folder / "gpu_check.json",
        {
            "hardware": hardware,
            "versions": versions,
            "passed": passed,
            "checks": [asdict(check) | {"passed": check.passed} for check in checks],
            "parts": [outcome._asdict() for outcome in outcomes],
        },
    )
    write_text(folder / "gpu_check.md", text)
    return text, passed


def _parts(cfg: DictConfig) -> dict[str, Callable[[DictConfig, Path], dict[str, Any]]]:
    """All parts by their names; the benchmark is one for each extractor and precision."""
    benchmarks = {
        f"benchmark {variant} {precision}": partial(_benchmark, variant, precision)
        for variant in cfg.extractors
        for precision in cfg.precisions
    }
    return {
        "tests": _tests,
        "onboarding": _onboarding,
        "dataset": _dataset,
        "agreement": _agreement,
        **benchmarks,
    }


def _run(command: Sequence[str], folder: Path, seconds: float) -> str:
    """Run a process and its children for so long at most, with what it prints in ``log.txt``; "ran", or why not."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            return f"stopped after {seconds:.0f} s"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return "ran" if status == 0 else f"failed with status {status}, see {folder / 'log.txt'}"


def _tests(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """The tests that need a GPU; they also count what makes the host wait for it."""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "-n", "0", str(root / cfg.tests)]
    found = subprocess.run(command, cwd=root, capture_output=True, text=True)
    write_text(folder / "pytest.txt", found.stdout + found.stderr)
    summary = (found.stdout.strip().splitlines() or ["nothing"])[-1]
    failed = Check("pytest's exit status", float(found.returncode), 0.0, "")
    return {"checks": [asdict(failed)], "figures": summary}


def _benchmark(variant: str, precision: str, cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Stages and pipeline at all batch sizes; peak memory and host reads are in its table."""
    result = run_benchmark(_benchmark_config(cfg, variant, precision), folder, ProgressBars())
    write_report(result, folder)
    checks = [asdict(check) for check in result.checks]
    reads = {row.name: row.host_syncs for row in result.rows if row.host_syncs}
    peak = max((row.memory_peak or 0 for row in result.rows), default=0)
    figures = f"peak {peak / 2**30:.1f} GiB; host reads {sum(reads.values())} in {len(reads)} rows"
    return {"checks": checks, "figures": figures, "benchmark": result.as_json()}


def _onboarding(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """One object, from mesh to representation."""
    overrides = [*_extractor(cfg, "auto"), f"device={cfg.device}"]
    overrides += (
        ["crop.size=210", "viewpoints.count=12", "words.num_words=32", "projection.num_components=32"]
        if cfg.quick
        else []
    )
    onboarder = build_method(load_config("config", overrides)).onboarder
    mesh = procedural_mesh(0, subdivisions=4 if cfg.quick else 6)
    once = MeasureSettings(1, 0, 1.0)
    took = measure(partial(onboarder, mesh, "object", ProgressBars()), torch.device(cfg.device), once)
    return _timed("onboarding of one object", took, cfg.limits.onboarding_seconds)


def _dataset(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """A dataset's number of instances through the whole pipeline, poses refined."""
    pipeline, workload = _pipeline(cfg, cfg.device, max(cfg.batch_sizes))
    batches = math.ceil((2 if cfg.quick else cfg.images) * cfg.instances_per_image / max(cfg.batch_sizes))

    def run() -> None:
        for _ in range(batches):
            estimate(pipeline, workload)

    with torch.inference_mode():
        estimate(pipeline, workload)
        took = measure(run, torch.device(cfg.device), MeasureSettings(1, 0, 1.0))
    name = f"{batches} batches of {max(cfg.batch_sizes)} instances, refined"
    return _timed(name, took, cfg.limits.dataset_seconds)


def _agreement(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """The same crops on the CPU and the device."""
    poses = []
    for device in ("cpu", cfg.device):
        pipeline, workload = _pipeline(cfg, device, 8, backbone=False)
        with torch.inference_mode():
            poses.append(estimate(pipeline, workload).T_camera_from_model.cpu())
    distance = torch.linalg.vector_norm(poses[0][:, :3, 3], dim=1)
    apart = pose_deviation(poses[1], poses[0], unit=distance)
    same = (apart.rotation < 0.1) & (apart.translation < 1e-3)
    share = 100.0 * float(same.double().mean())
    check = Check("poses as on the CPU", share, cfg.limits.agreement_percent, "%", at_least=True)
    worst = f"{float(apart.rotation.max()):.2g}°, {float(apart.translation.max()):.2g} of the distance"
    figures = f"largest difference {worst}"
    return {"checks": [asdict(check)], "figures": figures}


def _timed(name: str, took: Measurement, limit: float) -> dict[str, Any]:
    peak = took.memory.peak
    figures = "" if peak is None else f"peak {peak / 2**30:.1f} GiB"
    return {"checks": [asdict(Check(name, took.median, limit, "s"))], "figures": figures}


def _pipeline(
    cfg: DictConfig, device: str, batch_size: int, backbone: bool = True
) -> tuple[FoundPose, Workload]:
    """The pipeline with refinement on a workload; without a backbone nothing but prepared descriptors."""
    config = prepare(_benchmark_config(cfg, cfg.extractors[0], "auto", device))
    extractor = build_method(config).pipeline.extractor
    images = math.ceil(batch_size / cfg.instances_per_image)
    sizes = workload_sizes(config, extractor.channels, batch_size, images)
    workload = make_workload(sizes, device)
    scripted = ScriptedExtractor(sizes, workload.features, extractor if backbone else None)
    return make_stages(config, sizes).pipeline(scripted, "best"), workload


def _benchmark_config(cfg: DictConfig, variant: str, precision: str, device: str | None = None) -> DictConfig:
    batch_sizes = ",".join(str(size) for size in cfg.batch_sizes)
    return load_config(
        "benchmark",
        [
            *(f"device={device or cfg.device}", f"quick={str(cfg.quick).lower()}", f"precision={precision}"),
            *("extractor=dinov2", f"extractor.variant={variant}", "groups=[stages,pipeline]"),
            *(f"batch_sizes=[{batch_sizes}]", f"measure.seconds={0.02 if cfg.quick else 0.4}"),
        ],
    )


def _extractor(cfg: DictConfig, precision: str) -> list[str]:
    """Overrides for the largest extractor with random weights, which are as fast as others."""
    variant = f"extractor.variant={cfg.extractors[0]}"
    return [
        "extractor=dinov2",
        variant,
        "extractor.weights=random",
        "extractor.seed=0",
        f"extractor.precision={precision}",
    ]


def _existing(name: str) -> torch.device:
    """The device, or the CPU where there is no GPU, so that the page can be written all the same."""
    return torch.device("cpu" if name.startswith("cuda") and not torch.cuda.is_available() else name)


def _figures(outcome: Outcome) -> str:
    figures = outcome.content.get("figures")
    return f"; {figures}" if figures else ""

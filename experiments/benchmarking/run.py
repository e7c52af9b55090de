"""A whole benchmark, from its configuration."""

import copy
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import nn

from benchmarking.checks import make_checks
from benchmarking.curves import AXES, measure_curves
from benchmarking.hardware import describe_hardware, describe_versions
from benchmarking.inference import (
    HOOKED,
    YARDSTICK,
    Stages,
    backward_tasks,
    pipeline_tasks,
    stage_tasks,
)
from benchmarking.measure import MeasureSettings
from benchmarking.onboarding import OnboardingJob, onboarding_tasks, projected_descriptors, raw_descriptors
from benchmarking.references import kmeans_reference, ransac_references, run_references
from benchmarking.report import BenchmarkResult
from benchmarking.sizes import WorkloadSizes
from benchmarking.tasks import run_tasks
from benchmarking.workload import Workload, make_workload, with_crops
from foundpose.config import Method, build_method
from foundpose.features import CoordinateCode
from foundpose.onboarding import Progress
from foundpose.synthetic import procedural_mesh

GROUPS = ("stages", "pipeline", "backward", "onboarding", "references", "curves")
_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def run_benchmark(cfg: DictConfig, folder: Path, progress: Progress) -> BenchmarkResult:
    """Measure what the configuration asks for.

    Args:
        cfg: ``conf/benchmark.yaml``.
        folder: for files that are needed on the way.
        progress: is told of every task.

    Raises:
        ValueError: settings that make no sense.
    """
    start = time.perf_counter()
    _check(cfg)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    cfg = prepare(cfg)
    method = build_method(cfg)
    device = torch.device(cfg.device)
    hardware = describe_hardware(device)
    settings: MeasureSettings = instantiate(cfg.measure)
    extractor = method.pipeline.extractor
    backbones = {YARDSTICK: instantiate(cfg.yardstick).to(device).eval(), HOOKED: extractor}
    sizes = workload_sizes(cfg, extractor.channels)
    factory = partial(make_stages, cfg)
    workload = make_workload(sizes, device).to(_DTYPES[cfg.dtype])
    container: Any = OmegaConf.to_container(cfg, resolve=True)
    for name in ("preset", "presets", "preset_name"):
        del container[name]
    result = BenchmarkResult(container, hardware, describe_versions())
    stages = factory(sizes)
    rows = result.rows
    for batch_size in cfg.batch_sizes:
        given = _with_batch(workload, batch_size, cfg.crops_per_image)
        label = f"batch {batch_size}"
        if "stages" in cfg.groups:
            tasks = stage_tasks(stages, given, backbones, "stages")
            rows += run_tasks(tasks, device, settings, progress, f"stages, {label}")
        if "pipeline" in cfg.groups:
            tasks = pipeline_tasks(stages, given, extractor, "pipeline")
            rows += run_tasks(tasks, device, settings, progress, f"pipeline, {label}")
        if "backward" in cfg.groups and batch_size in cfg.backward_batch_sizes:
            tasks = backward_tasks(stages, given, {HOOKED: extractor}, "backward")
            rows += run_tasks(tasks, device, settings, progress, f"backward, {label}")
    if "onboarding" in cfg.groups:
        _measure_onboarding(cfg, method, workload, folder, settings, result, progress)
    if "references" in cfg.groups:
        references = ransac_references(stages, workload)
        if cfg.references.kmeans:
            descriptors = projected_descriptors(workload)
            references.append(
                kmeans_reference(descriptors, method.onboarder.words, cfg.references.kmeans_iterations)
            )
        result.comparisons = run_references(references, device, settings, progress)
    if "curves" in cfg.groups:
        values = {name: list(xs or []) for name, xs in cfg.curves.items()}
        quick = MeasureSettings(settings.repeats, min(settings.warmup, 1), cfg.curve_seconds)
        result.curves = measure_curves(
            workload, factory, values, cfg.crops_per_image, device, quick, progress
        )
    result.checks = make_checks(rows, result.comparisons, stages.retriever.num_templates, device.type)
    result.seconds = time.perf_counter() - start
    return result


def make_stages(
    cfg: DictConfig,
    sizes: WorkloadSizes,
    hypotheses: int | None = None,
    ransac_iterations: int | None = None,
    lm_iterations: int | None = None,
    stop_early: bool = True,
) -> Stages:
    """The configured stages, fitted to a workload's crops; a setting that is None keeps its configured value."""
    cfg = copy.deepcopy(cfg)
    cfg.crop.size, cfg.crop.fill = sizes.crop_size, sizes.fill
    alignments = ("refiner.alignment", "refiners.featuremetric.alignment")
    _set_where_known(cfg, "retrieval.num_templates", hypotheses or cfg.num_hypotheses)
    candidates = OmegaConf.select(cfg, "retrieval.retriever.num_templates")
    if candidates is not None:  # of which re-ranking keeps the templates
        cfg.retrieval.retriever.num_templates = max(candidates, hypotheses or cfg.num_hypotheses)
    _set_where_known(cfg, "pnp.iterations", ransac_iterations or cfg.ransac_iterations)
    for node in alignments:
        _set_where_known(cfg, f"{node}.max_iterations", lm_iterations or cfg.lm_iterations)
    if not stop_early:
        _set_where_known(cfg, "pnp.confidence", None)
        for node in alignments:
            _set_where_known(cfg, f"{node}.tolerance", 0.0)
    epnp = instantiate(cfg.pnp, solver="epnp", mirror=False) if "solver" in cfg.pnp else None

    def place(module: nn.Module | None) -> Any:
        return None if module is None else module.to(cfg.device).eval()

    return Stages(
        crop=place(instantiate(cfg.crop)),
        retriever=place(instantiate(cfg.retrieval)),
        matcher=place(instantiate(cfg.matcher)),
        pnp=place(instantiate(cfg.pnp)),
        refiner=place(None if cfg.get("refiner") is None else instantiate(cfg.refiner)),
        epnp=place(epnp),
        scorer=place(instantiate(cfg.scorer)),
        start=place(None if cfg.get("start") is None else instantiate(cfg.start)),
    )


def _measure_onboarding(
    cfg: DictConfig,
    method: Method,
    workload: Workload,
    folder: Path,
    settings: MeasureSettings,
    result: BenchmarkResult,
    progress: Progress,
) -> None:
    onboarder = method.onboarder
    device = torch.device(cfg.device)
    everything = cfg.onboarding.all_templates
    free = None
    if everything:
        free = instantiate(cfg.onboarder, extractor=CoordinateCode(workload.sizes.channels)).to(device).eval()
    # Onboarding computes in float32 whatever type the stages of inference have.
    given = workload if cfg.dtype == "float32" else make_workload(workload.sizes, device)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".") as scratch:
        job = OnboardingJob(
            onboarder=onboarder,
            mesh=procedural_mesh(cfg.sizes.seed, subdivisions=cfg.onboarding.mesh_subdivisions),
            workload=given,
            rendered=workload.sizes.templates if everything else cfg.onboarding.rendered,
            described=cfg.onboarding.described,
            folder=Path(scratch),
            free=free,
        )
        tasks = onboarding_tasks(job, raw_descriptors(given))
        result.rows += run_tasks(tasks, device, settings, progress)


def _check(cfg: DictConfig) -> None:
    """Raise ValueError for settings that would fail late or be ignored."""
    if not isinstance(cfg.quick, bool):
        raise ValueError(f"quick must be true or false, got {cfg.quick!r}")
    unknown = [group for group in cfg.groups if group not in GROUPS]
    if unknown:
        raise ValueError(f"groups must be among {list(GROUPS)}, got {unknown[0]!r}")
    for name in ("batch_sizes", "backward_batch_sizes"):
        if not OmegaConf.is_list(cfg[name]) or not all(isinstance(b, int) and b > 0 for b in cfg[name]):
            raise ValueError(f"{name} must be a list of positive integers, as in [1,16]; got {cfg[name]}")
    if cfg.dtype not in _DTYPES:
        raise ValueError(f"dtype must be one of {list(_DTYPES)}, got {cfg.dtype!r}")
    curves = [name for name in cfg.curves if name not in AXES]
    if curves:
        raise ValueError(f"there is no curve {curves[0]!r}; choose from {list(AXES)}")
    for name in ("num_hypotheses", "ransac_iterations", "lm_iterations", "crops_per_image"):
        if not isinstance(cfg[name], int) or cfg[name] < 1:
            raise ValueError(f"{name} must be a positive integer, got {cfg[name]}")
    if cfg.threads is not None and (not isinstance(cfg.threads, int) or cfg.threads < 1):
        raise ValueError(f"threads must be a positive integer or null, got {cfg.threads}")


def prepare(cfg: DictConfig) -> DictConfig:
    """The configuration with the weights and the precision of both extractors settled."""
    cfg = copy.deepcopy(cfg)
    extractor, yardstick = cfg.extractor, cfg.yardstick
    with open_dict(cfg):
        if "precision" in extractor:
            if cfg.precision is not None:
                extractor.precision = None if cfg.precision == "float32" else cfg.precision
            yardstick.precision = extractor.precision
        if cfg.random_weights and "weights" in extractor and "seed" in extractor:
            extractor.weights, extractor.seed = "random", 0
    return cfg


def workload_sizes(cfg: DictConfig, channels: int, batch_size: int = 1, images: int = 1) -> WorkloadSizes:
    """Sizes of the configured workload, for an extractor's descriptors and a number of crops and pictures."""
    settings: Any = OmegaConf.to_container(cfg.sizes, resolve=True)
    settings["image_size"] = tuple(settings["image_size"])
    return WorkloadSizes(**settings, channels=channels, batch_size=batch_size, images=images)


def _with_batch(workload: Workload, batch_size: int, crops_per_image: int) -> Workload:
    if batch_size == workload.sizes.batch_size:
        return workload
    return with_crops(workload, batch_size, -(-batch_size // crops_per_image))


def _set_where_known(cfg: DictConfig, path: str, value: object) -> None:
    """Set a value of a node that has it; the chosen option of a group may do without."""
    parent, _, name = path.rpartition(".")
    node = OmegaConf.select(cfg, parent)
    if isinstance(node, DictConfig) and name in node:
        node[name] = value

"""Tasks of onboarding: its stages on objects of the workload's size."""

import copy
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarking.tasks import Task
from benchmarking.workload import Workload
from foundpose.features import PcaProjection
from foundpose.features.pca import CovarianceAccumulator
from foundpose.onboarding import Onboarder, TemplateCameras
from foundpose.onboarding.onboarder import describe_by_words
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation

RENDERING = "rendering"
REGISTRATION = "registration"
PCA = "PCA"
KMEANS = "k-means"
BAGS = "bags of words"
WHOLE = "whole, extractor that costs nothing"
_GROUP = "onboarding"
_ROWS = 8192


class OnboardingJob(NamedTuple):
    """What is onboarded, and how much of it is run.

    Attributes:
        onboarder: with the extractor to be timed.
        mesh: the object.
        workload: its representation stands for what is fitted and saved, and for the number of patches.
        rendered: number of templates that are rendered.
        described: number of them that the extractor describes.
        folder: where the file goes.
        free: an onboarder with an extractor that costs nothing, to run whole; None leaves that out.
    """

    onboarder: Onboarder
    mesh: Mesh
    workload: Workload
    rendered: int
    described: int
    folder: Path
    free: Onboarder | None = None


def projected_descriptors(workload: Workload) -> Tensor:
    """The templates' descriptors (M, d), projected in single precision; the workload stays as precise as it is."""
    return copy.deepcopy(workload.representation.projection).float()(raw_descriptors(workload))


def raw_descriptors(workload: Workload) -> Tensor:
    """Raw descriptors (M, C) of all template patches, on the representation's device.

    They are the workload's, which lie on a surface, with noise whose spectrum falls as those of backbones do: without
    it, clustering would be easier than it is.
    """
    representation, sizes = workload.representation, workload.sizes
    generator = torch.Generator().manual_seed(sizes.seed + 2)
    codes = representation.descriptors.float()
    noise = torch.randn(codes.shape, generator=generator) / torch.arange(1.0, sizes.components + 1).sqrt()
    noise *= 0.5 * codes.square().sum(1).mean().sqrt().cpu() / noise.square().sum(1).mean().sqrt()
    projection = representation.projection
    return (codes + noise.to(codes.device)) @ projection.components.float() + projection.mean.float()


def onboarding_tasks(job: OnboardingJob, raw: Tensor) -> list[Task]:
    """Every stage of onboarding alone, and the whole with an extractor that costs nothing.

    Args:
        job: what is onboarded.
        raw: descriptors (M, C) of all template patches.
    """
    onboarder, mesh, representation = job.onboarder, job.mesh, job.workload.representation
    with torch.inference_mode(), onboarder.constants():
        cameras = onboarder.cameras(mesh)
        total = len(cameras.K_template)
        rendered = min(job.rendered, total)
        pictures = [onboarder.render(mesh, batch) for batch in _batches(cameras, rendered, onboarder)]
        described = min(job.described, rendered, onboarder.batch_size)
        first = next(_batches(cameras, described, onboarder))
        table = onboarder.register(mesh, first, pictures[0].masks[:described])
        projection = _fit_pca(raw, onboarder.projection)
        projected = _project(projection, raw)
    parallel = partial(Task, _GROUP, unit="template", projected=total)
    whole = partial(Task, _GROUP, unit="object")

    def render() -> None:
        for batch in _batches(cameras, rendered, onboarder):
            onboarder.render(mesh, batch)

    def register() -> None:
        batches = _batches(cameras, rendered, onboarder)
        for batch, picture in zip(batches, pictures, strict=True):
            onboarder.register(mesh, batch, picture.masks)

    path = job.folder / "representation.safetensors"
    size = f"{representation.memory_bytes()['total'] / 2**20:.0f} MiB"
    tasks = [
        whole("template cameras", partial(onboarder.cameras, mesh)),
        parallel(RENDERING, render, onboarder.batch_size, rendered),
        parallel(REGISTRATION, register, onboarder.batch_size, rendered),
        parallel(
            "extractor",
            partial(onboarder.describe, pictures[0].levels[:described], table),
            described,
            described,
        ),
        whole(PCA, lambda: _project(_fit_pca(raw, onboarder.projection), raw), note="fit and projection"),
        whole(KMEANS, partial(onboarder.words, projected), once=True, note=f"{len(raw)} descriptors"),
        whole(BAGS, partial(describe_by_words, representation, onboarder.bow, onboarder.idf_mode)),
        whole("save", partial(representation.save, path), note=size),
        whole("load", partial(_load, path, representation.words.device), note=size),
    ]
    if job.free is not None:
        tasks.append(whole(WHOLE, partial(job.free, mesh, "benchmark"), once=True))
    return tasks


def _batches(cameras: TemplateCameras, count: int, onboarder: Onboarder) -> Iterator[TemplateCameras]:
    """The first cameras, as many at a time as the onboarder takes."""
    for start in range(0, count, onboarder.batch_size):
        rows = slice(start, min(start + onboarder.batch_size, count))
        yield TemplateCameras(*(part[rows] for part in cameras))


def _fit_pca(raw: Tensor, projection: PcaProjection) -> PcaProjection:
    accumulator = CovarianceAccumulator(raw.shape[1], raw.device)
    for rows in raw.split(_ROWS):
        accumulator.update(rows)
    return PcaProjection(projection.num_components).to(raw.device).fit(accumulator)


def _project(projection: PcaProjection, raw: Tensor) -> Tensor:
    return torch.cat([projection(rows) for rows in raw.split(_ROWS)])


def _load(path: Path, device: torch.device) -> ObjectRepresentation:
    return ObjectRepresentation.load(path, device)

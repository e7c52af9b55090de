"""How far poses are from the truth before and after a refiner."""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry import rotation_angle
from foundpose.losses import point_matching_error
from foundpose.onboarding import Progress
from foundpose.refinement import RenderAndCompareRefiner
from foundpose.training.refiner_data import RefinerBatch, RefinerPictures

_LOST = 1.0  # diameters: larger point errors count as this


class RefinementErrors(NamedTuple):
    """Errors of N poses.

    Attributes:
        rotation: (N,) degrees.
        lateral: (N,) distance of the object's centre from where it should be, across the viewing ray, in diameters.
        depth: (N,) the same along it.
        matching: (N,) mean distance of the object's points in diameters, at most 1.
        valid: (N,) bool, the refiner gave a pose; where not, the errors are the initial pose's.
    """

    rotation: Tensor
    lateral: Tensor
    depth: Tensor
    matching: Tensor
    valid: Tensor


@torch.no_grad()  # a measurement
def evaluate_refiner(
    refiner: RenderAndCompareRefiner,
    pictures: RefinerPictures,
    batch_size: int = 32,
    progress: Progress | None = None,
) -> tuple[RefinementErrors, RefinementErrors]:
    """Errors of the pictures' perturbed poses, before and after refining them.

    Args:
        refiner: on any device.
        pictures: one perturbation of each is taken.
        batch_size: pictures at a time.
        progress: is told of every batch.
    """
    device = next((p.device for p in refiner.parameters()), torch.device("cpu"))
    before, after = [], []
    for start in range(0, len(pictures), batch_size):
        batch = pictures.__getitems__(range(start, min(start + batch_size, len(pictures))))
        count = len(batch.images)
        images, K, T_start = (x.to(device) for x in (batch.images, batch.K, batch.T_start))
        index = torch.arange(count, device=device)
        found = refiner.refine(images, K, T_start, index, batch.meshes, batch.mesh_index.to(device))
        centre = pictures.centre[batch.mesh_index]
        before.append(_errors(batch.T_start, torch.ones(count, dtype=torch.bool), batch, centre))
        after.append(_errors(found.T_camera_from_model.cpu(), found.valid.cpu(), batch, centre))
        if progress is not None:
            progress("poses", start + count, len(pictures))
    first, last = (
        RefinementErrors(*(torch.cat(field) for field in zip(*parts, strict=True)))
        for parts in (before, after)
    )
    return first, last


def _errors(T: Tensor, valid: Tensor, batch: RefinerBatch, centre: Tensor) -> RefinementErrors:
    found, truth = ((A[:, :3, :3] @ centre[:, :, None])[..., 0] + A[:, :3, 3] for A in (T, batch.T_true))
    ray = torch.nn.functional.normalize(truth, dim=-1)
    offset = found - truth
    along = (offset * ray).sum(-1)
    matching = point_matching_error(T, batch.T_true, batch.surface, diameter=batch.diameter, norm="l2")
    return RefinementErrors(
        rotation=torch.rad2deg(rotation_angle(T[:, :3, :3], batch.T_true[:, :3, :3])),
        lateral=torch.linalg.vector_norm(offset - along[:, None] * ray, dim=-1) / batch.diameter,
        depth=along.abs() / batch.diameter,
        matching=matching.clamp(max=_LOST),
        valid=valid,
    )


def summarize_refinement(errors: RefinementErrors) -> dict[str, float]:
    """Medians of the errors with their standard errors, and the mean matching error with its own."""
    summary: dict[str, float] = {"poses": len(errors.valid), "valid": float(errors.valid.float().mean())}
    for name in ("rotation", "lateral", "depth", "matching"):
        values: Tensor = getattr(errors, name)
        summary[f"median_{name}"] = float(values.median())
        summary[f"median_{name}_standard_error"] = _median_standard_error(values)
    summary["mean_matching"] = float(errors.matching.mean())
    summary["mean_matching_standard_error"] = _standard_error(errors.matching)
    return summary


def compare_refinement(before: RefinementErrors, after: RefinementErrors) -> dict[str, float]:
    """Shares of poses whose errors fell, and the mean change of the matching error, with standard errors.

    Raises:
        ValueError: another number of poses.
    """
    if len(before.valid) != len(after.valid):
        raise ValueError(f"these are {len(before.valid)} and {len(after.valid)} poses, not the same ones")
    change = after.matching - before.matching
    facts = {"mean_matching": float(change.mean()), "mean_matching_standard_error": _standard_error(change)}
    for name in ("rotation", "lateral", "depth", "matching"):
        improved = (getattr(after, name) < getattr(before, name)).float()
        facts[f"{name}_improved"] = float(improved.mean())
        facts[f"{name}_improved_standard_error"] = _standard_error(improved)
    return facts


def _standard_error(values: Tensor) -> float:
    """Of the mean."""
    return float(values.std(correction=0)) / len(values) ** 0.5


def _median_standard_error(values: Tensor) -> float:
    """Of the median: half the spread of 200 medians of samples drawn with replacement, 16th to 84th percentile."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(len(values), (200, len(values)), generator=generator)
    low, high = values[rows].median(dim=1).values.quantile(torch.tensor([0.16, 0.84]).to(values))
    return float(high - low) / 2.0

"""How far poses are from the truth, before and after training."""

from typing import NamedTuple

import torch
from torch import Tensor

_NAMES = ("rotation", "lateral", "depth", "matching")
RIGHT_DEGREES, RIGHT_DIAMETERS = 10.0, 0.1


class PoseErrors(NamedTuple):
    """Errors of N poses, against whichever of the equivalent true poses of a symmetric object is nearest.

    Attributes:
        rotation: (N,) degrees.
        lateral: (N,) displacement across the line of sight, diameters.
        depth: (N,) displacement along it, diameters.
        matching: (N,) mean distance of the model's points in diameters, at most 1.
        found: (N,) bool, there is a pose.
    """

    rotation: Tensor
    lateral: Tensor
    depth: Tensor
    matching: Tensor
    found: Tensor

    @property
    def right(self) -> Tensor:
        """Which poses (N,) are within 10 degrees and a tenth of the diameter."""
        near = torch.hypot(self.lateral, self.depth) < RIGHT_DIAMETERS
        return self.found & (self.rotation < RIGHT_DEGREES) & near


def join_errors(parts: list[PoseErrors]) -> PoseErrors:
    """Errors of all poses of several batches."""
    return PoseErrors(*map(torch.cat, zip(*parts, strict=True)))


def summarize(errors: PoseErrors) -> dict[str, float]:
    """Shares of poses found and right, medians of the errors and the mean matching error, with standard errors.

    Errors that are infinite where no pose was found have no median.
    """
    summary: dict[str, float] = {"poses": len(errors.found), "found": float(errors.found.float().mean())}
    summary |= _mean("right", errors.right.float())
    for name in _NAMES:
        values: Tensor = getattr(errors, name)
        if bool(torch.isfinite(values).all()):
            summary[f"median_{name}"] = float(values.median())
            summary[f"median_{name}_standard_error"] = _median_standard_error(values)
    return summary | _mean("mean_matching", errors.matching)


def compare(before: PoseErrors, after: PoseErrors) -> dict[str, float]:
    """Differences after minus before of the same poses, with the standard errors of paired differences.

    ``gained`` and ``lost`` count the poses that became right or wrong, ``…_improved`` are the shares of poses whose
    error fell.

    Raises:
        ValueError: another number of poses.
    """
    if len(before.found) != len(after.found):
        raise ValueError(f"these are {len(before.found)} and {len(after.found)} poses, not the same ones")
    right = after.right.float() - before.right.float()
    facts: dict[str, float] = {"gained": int((right > 0).sum()), "lost": int((right < 0).sum())}
    facts |= _mean("right", right) | _mean("mean_matching", after.matching - before.matching)
    for name in _NAMES:
        facts |= _mean(f"{name}_improved", (getattr(after, name) < getattr(before, name)).float())
    return facts


def _mean(name: str, values: Tensor) -> dict[str, float]:
    """A mean and its standard error."""
    error = float(values.std(correction=0)) / len(values) ** 0.5
    return {name: float(values.mean()), f"{name}_standard_error": error}


def _median_standard_error(values: Tensor) -> float:
    """Half the spread of 200 medians of samples drawn with replacement, 16th to 84th percentile."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(len(values), (200, len(values)), generator=generator)
    low, high = values[rows].median(dim=1).values.quantile(torch.tensor([0.16, 0.84]).to(values))
    return float(high - low) / 2.0

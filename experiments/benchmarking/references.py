"""Other implementations of the stages, timed in the same run on the same numbers.

Each comparison says how much faster ours is and how far the results agree, so that the speed means something.
"""

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarking.inference import Stages, pnp_name, stage_inputs
from benchmarking.measure import MeasureSettings, measure
from benchmarking.workload import Workload
from foundpose.onboarding import Progress
from foundpose.retrieval import VisualWords

Array = NDArray[Any]
_ROWS = 8192


@dataclass(frozen=True)
class Reference:
    """Ours and another implementation of the same.

    Attributes:
        name: of the comparison.
        ours: call of ours.
        reference: call of the other.
        agreement: figures from both results.
        once: too long to be repeated.
        unavailable: why the reference cannot be run, or None.
    """

    name: str
    ours: Callable[[], Any]
    reference: Callable[[], Any]
    agreement: Callable[[Any, Any], dict[str, float]]
    once: bool = False
    unavailable: str | None = None


@dataclass(frozen=True)
class Comparison:
    """A reference that was run; seconds are medians of a call.

    Attributes:
        name: of the comparison.
        ours: seconds, or None where the reference is missing.
        reference: seconds.
        times_faster: the reference's time over ours.
        agreement: figures from both results.
        note: why it was left out.
    """

    name: str
    ours: float | None
    reference: float | None
    times_faster: float | None
    agreement: dict[str, float]
    note: str = ""


def run_references(
    references: Sequence[Reference], device: torch.device, settings: MeasureSettings, progress: Progress
) -> list[Comparison]:
    """Time the references and ours, one after the other; references run on the CPU."""
    rows = []
    progress("references", 0, len(references))
    for done, each in enumerate(references, 1):
        if each.unavailable:
            rows.append(Comparison(each.name, None, None, None, {}, each.unavailable))
        else:
            rows.append(_compare(each, device, settings))
        progress("references", done, len(references))
    return rows


def _compare(each: Reference, device: torch.device, settings: MeasureSettings) -> Comparison:
    last: dict[str, Any] = {}
    seconds = {}
    how = settings.once() if each.once else settings
    calls = {"ours": (each.ours, device), "reference": (each.reference, torch.device("cpu"))}
    with torch.inference_mode():
        for name, (call, where) in calls.items():
            seconds[name] = measure(lambda n=name, c=call: last.update({n: c()}), where, how).median  # type: ignore[misc]
        agreement = each.agreement(last["ours"], last["reference"])
    ours, reference = seconds["ours"], seconds["reference"]
    return Comparison(each.name, ours, reference, reference / ours, agreement)


def ransac_references(stages: Stages, workload: Workload) -> list[Reference]:
    """OpenCV's RANSAC, one problem after the other, with both of its minimal solvers."""
    inputs, coarse = stage_inputs(stages, workload, refine_all=False)
    arguments, h = inputs["pnp"], coarse.templates.index.shape[1]
    given = arguments[0]
    fields = (_numpy(x) for x in (given.points_image, given.points_model, given.K, given.valid))
    problems = [
        (x[mask].astype(np.float64), u[mask].astype(np.float64), k.astype(np.float64))
        for u, x, k, mask in zip(*fields, strict=True)
    ]
    pnp = stages.pnp
    confidence = 0.9999 if pnp.confidence is None else pnp.confidence

    def opencv(solver: str) -> Tensor:
        import cv2

        flag = {"p3p": cv2.SOLVEPNP_P3P, "epnp": cv2.SOLVEPNP_EPNP}[solver]
        poses = torch.full((len(problems), 4, 4), torch.nan, dtype=torch.float64)
        for i, (x, u, k) in enumerate(problems):
            if len(x) < 4:
                continue
            ok, rotation, t, _ = cv2.solvePnPRansac(
                *(x, u, k, None),
                iterationsCount=len(pnp.draws),
                reprojectionError=pnp.threshold,
                confidence=confidence,
                flags=flag,
            )
            if ok:
                poses[i] = torch.eye(4, dtype=torch.float64)
                poses[i, :3] = torch.from_numpy(np.hstack([cv2.Rodrigues(rotation)[0], t]))
        return poses

    def agreement(ours: Tensor, theirs: Tensor) -> dict[str, float]:
        figures = {}
        for name, poses in (("ours", ours.double().cpu()), ("reference", theirs)):
            counts = _inliers(poses, problems, pnp.threshold)
            figures[f"mean_inliers_{name}"] = float(counts.mean())
            figures[f"best_of_each_{name}"] = float(counts.reshape(-1, h).max(1).mean())
        return figures

    return [
        Reference(
            f"{pnp_name(h)}: OpenCV's RANSAC with {solver}, ours with {mine.solver}",
            lambda mine=mine: mine(*arguments).T_camera_from_model,  # type: ignore[misc]
            lambda solver=solver: opencv(solver),  # type: ignore[misc]
            agreement,
            unavailable=None if is_installed("cv2") else _how_to_install("OpenCV"),
        )
        for solver, mine in (("p3p", pnp), ("epnp", stages.epnp or pnp))
    ]


def kmeans_reference(descriptors: Tensor, words: VisualWords, iterations: int) -> Reference:
    """Visual words by faiss, or where it is missing by scikit-learn."""
    fast = is_installed("faiss")
    points = np.ascontiguousarray(_numpy(descriptors.float()))
    other = faiss_kmeans if fast else sklearn_kmeans

    def agreement(ours: Tensor, theirs: NDArray[np.float32]) -> dict[str, float]:
        mine = inertia(descriptors, ours)
        reference = inertia(descriptors, torch.from_numpy(theirs).to(descriptors))
        return {"inertia_ratio": mine / reference, "iterations_of_reference": float(iterations)}

    return Reference(
        f"k-means, {words.num_words} words: {'faiss' if fast else 'scikit-learn'}",
        lambda: words(descriptors),
        lambda: other(points, words.num_words, iterations),
        agreement,
        once=True,
        unavailable=None if fast or is_installed("sklearn") else _how_to_install("faiss-cpu or scikit-learn"),
    )


def faiss_kmeans(points: NDArray[np.float32], clusters: int, iterations: int) -> NDArray[np.float32]:
    """Centroids (k, d) by faiss, of all points (it samples them by default)."""
    # It tells how it looked for its own libraries.
    logging.getLogger("faiss").setLevel(logging.WARNING)
    import faiss

    size = len(points)
    kmeans = faiss.Kmeans(points.shape[1], clusters, niter=iterations, seed=0, max_points_per_centroid=size)
    kmeans.train(points)
    return np.asarray(kmeans.centroids)


def sklearn_kmeans(points: NDArray[np.float32], clusters: int, iterations: int) -> NDArray[np.float32]:
    """Centroids (k, d) by scikit-learn."""
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # That the iterations do not suffice is what they are there to say.
        warnings.simplefilter("ignore", ConvergenceWarning)
        kmeans = KMeans(clusters, n_init=1, max_iter=iterations, tol=0.0, random_state=0).fit(points)
    return np.asarray(kmeans.cluster_centers_, dtype=np.float32)


def inertia(points: Tensor, centroids: Tensor) -> float:
    """Sum of squared distances of points (N, d) to the nearest of the centroids (k, d), from differences."""
    total = torch.zeros((), dtype=torch.float64)
    for block in points.split(_ROWS):
        nearest = torch.cdist(block, centroids).argmin(dim=1)
        total += (block - centroids[nearest]).double().square().sum().cpu()
    return float(total)


def is_installed(module: str) -> bool:
    """Whether a module can be imported, without doing so."""
    return find_spec(module) is not None


def _inliers(
    T: Tensor, problems: Sequence[tuple[Array, Array, Array]], threshold: float
) -> NDArray[np.float64]:
    """Number of points that poses (P, 4, 4) project within the threshold; 0 for no pose."""
    counts = np.zeros(len(problems))
    for i, ((x, u, k), pose) in enumerate(zip(problems, T.numpy(), strict=True)):
        y = (x @ pose[:3, :3].T + pose[:3, 3]) @ k.T
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.linalg.norm(y[:, :2] / y[:, 2:] - u, axis=1)
        counts[i] = ((error <= threshold) & (y[:, 2] > 0)).sum()
    return counts


def _how_to_install(what: str) -> str:
    return f"{what} is not installed; pip install 'foundpose[benchmark]'"


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy()

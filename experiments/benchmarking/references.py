"""Other implementations of the stages, timed in the same run on the same numbers.

Each comparison says how much faster ours is and how far the results agree, so that the speed means something.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarking.hardware import is_installed
from benchmarking.inference import Stages, pnp_name, stage_inputs
from benchmarking.measure import MeasureSettings, measure
from benchmarking.numpy_method import match_by_template, retrieve_by_template
from benchmarking.workload import Workload
from foundpose.geometry import pose_deviation
from foundpose.onboarding import Progress
from foundpose.pnp import LevenbergMarquardtPnp, RansacPnp
from foundpose.refinement import FeaturemetricRefiner, Observation, PoseProposals
from foundpose.refinement.refiners import alignment_problem
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SpatialReranker, TemplateRetriever, VisualWords

Array = NDArray[Any]
Result = Any


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
    ours: Callable[[], Result]
    reference: Callable[[], Result]
    agreement: Callable[[Result, Result], dict[str, float]]
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
    how = settings.once() if each.once else settings
    last: dict[str, Result] = {}

    def keep(name: str, call: Callable[[], Result]) -> Callable[[], None]:
        def run() -> None:
            last[name] = call()

        return run

    with torch.inference_mode():
        ours = measure(keep("ours", each.ours), device, how).median
        theirs = measure(keep("reference", each.reference), torch.device("cpu"), how).median
        agreement = each.agreement(last["ours"], last["reference"])
    return Comparison(each.name, ours, theirs, theirs / ours, agreement)


def inference_references(stages: Stages, workload: Workload) -> list[Reference]:
    """References of retrieval, matching, RANSAC, polish and refinement."""
    inputs, coarse = stage_inputs(stages, workload)
    representation = workload.representation
    references: list[Reference] = []
    retriever = stages.retriever
    if isinstance(retriever, SpatialReranker):
        retriever = retriever.retriever
    if isinstance(retriever, TemplateRetriever) and retriever.bow.sigma != "auto":
        query = coarse.query
        arrays = (_numpy(query.descriptors), _numpy(query.valid), *_index_arrays(representation))
        bow, sigma, num_templates = retriever.bow, retriever.bow.sigma, retriever.num_templates
        references.append(
            Reference(
                "retrieval: NumPy, template by template",
                lambda: retriever(*inputs["retriever"]).index,
                lambda: retrieve_by_template(
                    *arrays,
                    sigma=sigma,
                    num_nearest=bow.num_nearest,
                    num_templates=num_templates,
                    root=bow.normalization == "hellinger",
                ),
                _same_indices("same_top"),
            )
        )
    arguments = [_numpy(x) for x in inputs["matcher"][:4]]
    references.append(
        Reference(
            "matching: NumPy, template by template",
            lambda: stages.matcher(*inputs["matcher"]).template_patch,
            lambda: match_by_template(*arguments),
            _same_indices("same_matches", inputs["matcher"][1]),
        )
    )
    references += _pnp_references(stages, stages.pnp, inputs["pnp"], coarse.templates.index.shape[1])
    references.append(_polish_reference(stages.pnp, inputs["pnp"]))
    if isinstance(stages.refiner, FeaturemetricRefiner):
        references.append(_refinement_reference(stages.refiner, *inputs["refiner"]))
    return references


def kmeans_reference(descriptors: Tensor, words: VisualWords, iterations: int) -> Reference:
    """Visual words by faiss, or where it is missing by scikit-learn."""
    from benchmarking.clustering import faiss_kmeans, inertia, sklearn_kmeans

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


def _pnp_references(stages: Stages, pnp: RansacPnp, arguments: list[Any], h: int) -> list[Reference]:
    """OpenCV's RANSAC, one problem after the other."""
    points_image, points_model, K, valid = (_numpy(x) for x in arguments[:4])
    problems = [
        (x[mask].astype(np.float64), u[mask].astype(np.float64), k.astype(np.float64))
        for u, x, k, mask in zip(points_image, points_model, K, valid, strict=True)
    ]
    iterations = len(pnp.draws)
    confidence = 0.9999 if pnp.confidence is None else pnp.confidence

    def opencv(solver: str) -> Callable[[], Tensor]:
        def run() -> Tensor:
            import cv2

            flag = {"p3p": cv2.SOLVEPNP_P3P, "epnp": cv2.SOLVEPNP_EPNP}[solver]
            poses = torch.full((len(problems), 4, 4), torch.nan, dtype=torch.float64)
            for i, (x, u, k) in enumerate(problems):
                if len(x) < 4:
                    continue
                ok, rotation, t, _ = cv2.solvePnPRansac(
                    *(x, u, k, None),
                    iterationsCount=iterations,
                    reprojectionError=pnp.threshold,
                    confidence=confidence,
                    flags=flag,
                )
                if ok:
                    T = np.eye(4)
                    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], t[:, 0]
                    poses[i] = torch.from_numpy(T)
            return poses

        return run

    def agreement(ours: Tensor, theirs: Tensor) -> dict[str, float]:
        mine = _inliers(ours.double().cpu(), problems, pnp.threshold)
        other = _inliers(theirs, problems, pnp.threshold)
        return {
            "mean_inliers_ours": float(mine.mean()),
            "mean_inliers_reference": float(other.mean()),
            "best_of_each_ours": float(mine.reshape(-1, h).max(1).mean()),
            "best_of_each_reference": float(other.reshape(-1, h).max(1).mean()),
        }

    unavailable = None if is_installed("cv2") else _how_to_install("OpenCV")
    choices = [("p3p", pnp), ("epnp", stages.epnp or pnp)]
    return [
        Reference(
            f"{pnp_name(h)}: OpenCV's RANSAC with {solver}, ours with {mine.solver}",
            lambda mine=mine: mine(*arguments).T_camera_from_model,  # type: ignore[misc]
            opencv(solver),
            agreement,
            unavailable=unavailable,
        )
        for solver, mine in choices
    ]


def _inliers(T: Tensor, problems: Sequence[tuple[Any, Any, Any]], threshold: float) -> NDArray[np.float64]:
    """Number of points that poses (P, 4, 4) project within the threshold; 0 for no pose."""
    counts = np.zeros(len(problems))
    for i, ((x, u, k), pose) in enumerate(zip(problems, T.numpy(), strict=True)):
        y = (x @ pose[:3, :3].T + pose[:3, 3]) @ k.T
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.linalg.norm(y[:, :2] / y[:, 2:] - u, axis=1)
        counts[i] = ((error <= threshold) & (y[:, 2] > 0)).sum()
    return counts


def _polish_reference(pnp: RansacPnp, arguments: list[Any]) -> Reference:
    """One least-squares pose on the inliers of the first problem, from a pose a little off."""
    from benchmarking.least_squares import pnp_least_squares, turned

    found = pnp(*arguments)
    points_image, points_model, K = (x[:1] for x in arguments[:3])
    weights = found.inliers[:1].to(K.dtype)
    start = turned(found.T_camera_from_model[:1], points_model[0], degrees=1.0)
    optimiser = LevenbergMarquardtPnp(max_iterations=30)
    chosen = _numpy(found.inliers[0])
    x, u, k = (_numpy(t[0]).astype(np.float64) for t in (points_model, points_image, K))
    T = _numpy(start[0]).astype(np.float64)
    return Reference(
        "polish of 1 pose: scipy.optimize.least_squares",
        lambda: optimiser(start, points_image, points_model, K, weights).T_camera_from_model[0],
        lambda: pnp_least_squares(T, x[chosen], u[chosen], k),
        _pose_agreement,
    )


def _refinement_reference(
    refiner: FeaturemetricRefiner, proposals: PoseProposals, observation: Observation
) -> Reference:
    """One featuremetric refinement: the first crop's."""
    from benchmarking.least_squares import UNSUPPORTED, featuremetric_least_squares, is_supported

    alignment, one = refiner.alignment, alignment_problem(proposals, observation).take(slice(1))
    start = proposals.T_crop_from_model[0, :1]

    def agreement(ours: Tensor, theirs: Tensor) -> dict[str, float]:
        both = torch.stack([ours, theirs.to(ours)])
        costs = [alignment(T[None], one).initial_cost.item() for T in (start[0], *both)]
        return _pose_agreement(ours, theirs) | {
            "cost_before": costs[0],
            "cost_ours": costs[1],
            "cost_reference": costs[2],
        }

    return Reference(
        "refinement of 1 hypothesis: scipy.optimize.least_squares",
        lambda: alignment(start, one).T_crop_from_model[0],
        lambda: featuremetric_least_squares(start[0], one, alignment),
        agreement,
        unavailable=None if is_supported(alignment) else UNSUPPORTED,
    )


def _same_indices(name: str, valid: Tensor | None = None) -> Callable[[Tensor, Any], dict[str, float]]:
    """Share of equal indices; of the patches that are valid, for matches (B, h, P)."""

    def agreement(ours: Tensor, theirs: NDArray[np.int64]) -> dict[str, float]:
        same = _numpy(ours) == theirs
        if valid is not None:
            same = same[np.broadcast_to(_numpy(valid)[:, None], same.shape)]
        return {name: float(same.mean())}

    return agreement


def _pose_agreement(ours: Tensor, theirs: Tensor) -> dict[str, float]:
    """Turn between two poses in degrees, and their distance as a share of the distance from the camera."""
    a, b = ours.double().cpu(), theirs.double().cpu()
    apart = pose_deviation(a, b, unit=b[:3, 3].norm())
    return {"degrees_apart": float(apart.rotation), "distance_apart": float(apart.translation)}


def _index_arrays(representation: ObjectRepresentation) -> tuple[Array, Array, Array]:
    return _numpy(representation.words), _numpy(representation.idf), _numpy(representation.template_bow)


def _how_to_install(what: str) -> str:
    return f"{what} is not installed; pip install 'foundpose[benchmark]'"


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy()

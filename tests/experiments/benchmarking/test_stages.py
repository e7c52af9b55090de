"""Tasks, references and curves on a small workload."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from torch import nn

from benchmarking import MeasureSettings, WorkloadSizes, make_workload, with_crops
from benchmarking.curves import measure_curves
from benchmarking.inference import (
    COARSE,
    REFINE_ONE,
    REFINED,
    accuracy,
    backward_tasks,
    estimate,
    pipeline_tasks,
    record_calls,
    stage_inputs,
    stage_tasks,
)
from benchmarking.references import (
    Reference,
    faiss_kmeans,
    inertia,
    is_installed,
    kmeans_reference,
    ransac_references,
    run_references,
    sklearn_kmeans,
)
from benchmarking.run import make_stages
from benchmarking.scripted import ScriptedExtractor
from foundpose.features import PatchExtractor, PatchFeatures
from foundpose.geometry import pose_deviation, rotation_angle
from foundpose.optimization import BarronLoss, Huber
from foundpose.pnp import LevenbergMarquardtPnp, PnpResult
from foundpose.refinement import FeaturemetricAlignment
from foundpose.refinement.refiners import alignment_problem
from foundpose.retrieval import VisualWords
from tests.experiments.benchmarking.least_squares import (
    featuremetric_least_squares,
    is_supported,
    pnp_least_squares,
    turned,
)
from tests.experiments.benchmarking.numpy_method import match_by_template, retrieve_by_template

CONF = Path(__file__).resolve().parents[3] / "conf"
CPU = torch.device("cpu")
ONCE = MeasureSettings(1, 0, 0.01)
SIZES = WorkloadSizes(
    templates=200,
    patches=120,
    components=48,
    channels=64,
    words=200,
    crop_size=238,
    batch_size=2,
    outliers=0.1,
)


def silent(stage: str, done: int, total: int) -> None:
    pass


class CountingExtractor(PatchExtractor):
    """Counts its calls."""

    def __init__(self) -> None:
        super().__init__(1, 14.0, 6.5)
        self.calls = 0

    def forward(self, images):
        self.calls += 1
        return PatchFeatures(nn.functional.avg_pool2d(images, 14), None)

    def fingerprint(self):
        return {}


@pytest.fixture(scope="module")
def workload():
    return make_workload(SIZES)


@pytest.fixture(scope="module")
def factory():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("benchmark", overrides=["quick=true"])
    return partial(make_stages, cfg)


@pytest.fixture(scope="module")
def stages(factory):
    return factory(SIZES)


def test_stages_run_on_what_the_pipeline_hands_them(stages, workload):
    backbone = CountingExtractor()
    tasks = {task.name: task for task in stage_tasks(stages, workload, {"backbone": backbone}, "stages")}
    with torch.inference_mode():
        results = {name: task.call() for name, task in tasks.items()}
        whole = estimate(
            stages.pipeline(ScriptedExtractor(workload.sizes, workload.features), "all"), workload
        )
    assert list(tasks) == [
        *("backbone", "crop", "query patches", "PCA projection", "words and bag of words"),
        *("candidates for re-ranking", "retrieval"),
        *("template gather", "matching", "PnP of 5 hypotheses"),
        *("templates' own poses", "polish of the templates' poses", "verification"),
        "PnP of 5 hypotheses, epnp",
        *(REFINE_ONE, "refinement of 5 hypotheses"),
    ]
    assert backbone.calls == 1
    assert torch.equal(results["crop"].images, whole.crops.images)
    assert torch.equal(results["PCA projection"], whole.query.descriptors)
    assert torch.equal(results["retrieval"].index, whole.templates.index)
    assert torch.equal(results["matching"].distance, whole.correspondences.distance)
    pnp = results["PnP of 5 hypotheses"]
    assert isinstance(pnp, PnpResult)
    # The pipeline keeps the better of RANSAC's pose and the template's own.
    ransac = stages._replace(start=None).pipeline(ScriptedExtractor(workload.sizes, workload.features), "all")
    assert torch.equal(pnp.num_inliers.reshape(2, 5), estimate(ransac, workload).hypotheses.num_inliers)
    refined = results["refinement of 5 hypotheses"]
    assert whole.refined is not None
    assert torch.equal(refined.T_crop_from_model, whole.refined.T_crop_from_model)
    assert results[REFINE_ONE].score.shape == (2, 1)
    assert all(task.units == 2 and task.batch_size == 2 for task in tasks.values())


def test_stages_have_the_configured_settings(factory):
    stages = factory(SIZES, hypotheses=3, ransac_iterations=50, lm_iterations=7, stop_early=False)
    assert stages.crop.size == 238
    assert stages.crop.fill == pytest.approx(SIZES.fill)
    assert stages.retriever.num_templates == 3
    assert len(stages.pnp.draws) == 50
    assert stages.pnp.confidence is None
    assert stages.epnp.solver == "epnp"
    assert stages.refiner.alignment.max_iterations == 7
    assert stages.refiner.alignment.tolerance == 0.0
    usual = factory(SIZES)
    assert usual.pnp.confidence == 0.9999
    assert (usual.retriever.num_templates, len(usual.pnp.draws)) == (5, 400)


@pytest.mark.slow
def test_pipeline_runs_the_extractor_and_finds_poses(stages, workload):
    workload = with_crops(workload, 16)
    backbone = CountingExtractor()
    tasks = {task.name: task for task in pipeline_tasks(stages, workload, backbone, "pipeline")}
    assert set(tasks) == {
        *(COARSE, REFINED, "pipeline, all refined"),
        *(f"{COARSE}, with extractor", f"{REFINED}, with extractor"),
    }
    with torch.inference_mode():
        tasks[COARSE].call()
        assert backbone.calls == 0
        tasks[f"{COARSE}, with extractor"].call()
    assert backbone.calls == 1
    assert tasks[COARSE].facts["poses_found"] > 0.9
    assert tasks[COARSE].facts["median_degrees"] < 3.0
    assert tasks[REFINED].facts["median_degrees"] < tasks[COARSE].facts["median_degrees"]
    extractor = ScriptedExtractor(workload.sizes, workload.features)
    estimates = estimate(stages.pipeline(extractor), workload)
    truth = estimates._replace(T_camera_from_model=workload.T_camera_from_model)
    assert accuracy(truth, workload)["median_degrees"] < 0.1
    none = estimates._replace(valid=torch.zeros_like(estimates.valid))
    assert accuracy(none, workload)["poses_found"] == 0.0


def test_every_gradient_is_finite_and_not_zero(stages, workload):
    tasks = backward_tasks(stages, workload, {"extractor": CountingExtractor()}, "backward")
    assert len(tasks) == 7
    for task in tasks:
        assert task.gradient
        for gradient in task.call():
            assert torch.isfinite(gradient).all(), task.name
            assert gradient.abs().max() > 0, task.name


def test_calls_with_keywords_are_refused():
    module = nn.Identity()
    with pytest.raises(RuntimeError, match="calls it with keywords"):
        record_calls({"it": module}, lambda: module(input=1))


def arrays(*tensors):
    return [tensor.numpy() for tensor in tensors]


def test_ransac_references_agree_with_ours(stages, workload):
    comparisons = run_references(ransac_references(stages, workload), CPU, ONCE, silent)
    assert [each.name.split(",")[0].split()[-1] for each in comparisons] == ["p3p", "epnp"]
    for each in comparisons:
        found = each.agreement
        assert found["mean_inliers_ours"] > 30
        assert found["mean_inliers_ours"] == pytest.approx(found["mean_inliers_reference"], rel=0.15)
        assert each.times_faster == pytest.approx(each.reference / each.ours)


@torch.inference_mode()
def test_retrieval_and_matching_template_by_template(stages, workload):
    inputs, coarse = stage_inputs(stages, workload)
    given, retriever = workload.representation, stages.retriever.retriever
    found = retrieve_by_template(
        *arrays(coarse.query.descriptors, coarse.query.valid, given.words, given.idf, given.template_bow),
        sigma=retriever.bow.sigma,
        num_nearest=retriever.bow.num_nearest,
        num_templates=retriever.num_templates,
        root=retriever.bow.normalization == "hellinger",
    )
    assert np.array_equal(found, retriever(*inputs["retriever"]).index)
    query, patches = inputs["matcher"][:2]
    matches = match_by_template(*arrays(query.descriptors, query.valid, patches.descriptors, patches.valid))
    valid = np.broadcast_to(query.valid[:, None], matches.shape)
    assert np.array_equal(matches[valid], stages.matcher(*inputs["matcher"]).template_patch.numpy()[valid])


@torch.inference_mode()
def test_polish_by_scipy(stages, workload):
    """From a pose a little off, both come to the same pose on the inliers of the first problem."""
    arguments = stage_inputs(stages, workload)[0]["pnp"]
    found = stages.pnp(*arguments)
    problem = arguments[0].take(slice(1))
    problem = replace(problem, weights=found.inliers[:1])
    start = turned(found.T_camera_from_model[:1], problem.points_model[0], degrees=1.0)
    ours = LevenbergMarquardtPnp(max_iterations=30)(start, problem)
    chosen = found.inliers[0]
    numbers = (start, problem.points_model, problem.points_image, problem.K)
    T, x, u, k = arrays(*(t[0].double() for t in numbers))
    theirs = pnp_least_squares(T, x[chosen], u[chosen], k)
    apart = pose_deviation(ours.T_camera_from_model[0].double(), theirs, unit=theirs[:3, 3].norm())
    assert apart.rotation < 0.02
    assert apart.translation < 1e-4


def test_references_that_cannot_be_run_say_why(stages, workload, monkeypatch):
    monkeypatch.setattr("benchmarking.references.is_installed", lambda module: False)
    references = ransac_references(stages, workload)
    words = kmeans_reference(torch.randn(50, 4), VisualWords(5), 10)
    lacking = [each for each in [*references, words] if each.unavailable]
    rows = run_references(lacking, CPU, ONCE, silent)
    assert [row.note.split(" is ")[0] for row in rows] == ["OpenCV", "OpenCV", "faiss-cpu or scikit-learn"]
    assert all(row.ours is None and row.times_faster is None for row in rows)


def test_settings_that_scipy_does_not_know(stages):
    assert is_supported(FeaturemetricAlignment())
    assert not is_supported(FeaturemetricAlignment(Huber(1.0)))
    assert not is_supported(FeaturemetricAlignment(BarronLoss(1.0, 0.5)))
    assert not is_supported(FeaturemetricAlignment(residual="norm"))
    with pytest.raises(ValueError, match="bilinear interpolation only"):
        featuremetric_least_squares(torch.eye(4), None, FeaturemetricAlignment(interpolation="bicubic"))


def test_scipy_minimises_our_cost(stages, workload):
    """From a pose a little off the optimum, both come to the same minimum of the cost as ours measures it."""
    proposals, observation = next(
        task.call.args for task in stage_tasks(stages, workload, {}, "s") if task.name == REFINE_ONE
    )
    problem = alignment_problem(proposals, observation)
    alignment = FeaturemetricAlignment(max_iterations=100, tolerance=1e-9)
    with torch.no_grad():
        optimum = alignment(proposals.T_crop_from_model[:, 0], problem).T_crop_from_model[:1]
        one = problem.take(slice(1))
        start = turned(optimum, problem.points_model[0, problem.valid[0]], degrees=0.5)
        ours = alignment(start, one)
        theirs = featuremetric_least_squares(start[0], one, alignment)
        cost = alignment(theirs[None].float(), one).initial_cost
    assert cost < 0.999 * ours.initial_cost
    assert cost.item() == pytest.approx(ours.cost.item(), rel=2e-3)


def test_turned():
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[:, :3, 3] = torch.tensor([1.0, 2.0, 30.0])
    points = torch.randn(20, 3, dtype=torch.float64)
    moved = turned(T, points, degrees=3.0)
    assert torch.rad2deg(rotation_angle(T[0, :3, :3], moved[0, :3, :3])).item() == pytest.approx(3.0)
    centre = points.mean(0)
    assert torch.allclose(moved[0, :3, :3] @ centre + moved[0, :3, 3], centre + T[0, :3, 3])


@pytest.mark.parametrize("library", ["sklearn", "faiss"])
def test_kmeans_references_find_clusters(library):
    if not is_installed(library):
        pytest.skip(f"{library} is not installed")
    rng = np.random.default_rng(0)
    centres = 10 * rng.standard_normal((8, 5))
    points = (centres.repeat(50, axis=0) + rng.standard_normal((400, 5))).astype(np.float32)
    run = {"sklearn": sklearn_kmeans, "faiss": faiss_kmeans}[library]
    centroids = run(points, 16, 30)
    assert centroids.shape == (16, 5)
    exact = ((points[:, None].astype(np.float64) - centroids[None]) ** 2).sum(-1).min(1).sum()
    assert inertia(torch.from_numpy(points), torch.from_numpy(centroids)) == pytest.approx(exact, rel=1e-4)
    of_truth = ((points - centres.repeat(50, axis=0)) ** 2).sum()
    assert exact < of_truth


def test_ratio_and_agreement_of_a_slower_reference():
    calls = []

    def ours():
        calls.append("ours")
        return 1

    def theirs():
        calls.append("theirs")
        time.sleep(0.02)
        return 2

    reference = Reference("it", ours, theirs, lambda a, b: {"sum": a + b}, once=True)
    (row,) = run_references([reference], CPU, MeasureSettings(9, 4, 1.0), silent)
    assert calls == ["ours", "theirs"]
    assert row.agreement == {"sum": 3}
    assert row.reference >= 0.02
    assert row.times_faster > 2


@pytest.mark.slow
def test_curves(factory, workload):
    values = {
        "batch": [1, 3],
        "templates": [30, 210],
        "words": [50],
        "patches": [60],
        "hypotheses": [2],
        "ransac_iterations": [20],
        "lm_iterations": [3],
    }
    told = []
    curves = measure_curves(workload, factory, values, 8, CPU, ONCE, lambda *args: told.append(args))
    assert [curve.name for curve in curves] == list(values)
    for curve in curves:
        assert curve.series
        for points in curve.series.values():
            assert [point.x for point in points] == values[curve.name]
            assert all(0 < point.lower <= point.median <= point.upper for point in points)
    assert [curve.batch_size for curve in curves] == [None, *[2] * 6]
    assert set(curves[5].series) == {
        "PnP of 5 hypotheses, stopped when confident",
        "PnP of 5 hypotheses, all samples",
    }
    assert ("curve templates", 2, 2) in told
    assert measure_curves(workload, factory, {"batch": []}, 8, CPU, ONCE, silent) == []
    with pytest.raises(ValueError, match="there is no curve 'colour'"):
        measure_curves(workload, factory, {"colour": [1]}, 8, CPU, ONCE, silent)


def test_double_precision_pipeline(stages):
    workload = make_workload(SIZES).to(torch.float64)
    extractor = ScriptedExtractor(workload.sizes, workload.features)
    with torch.inference_mode():
        estimates = estimate(stages.pipeline(extractor, "best"), workload)
    assert estimates.T_camera_from_model.dtype == torch.float64
    assert estimates.valid.all()

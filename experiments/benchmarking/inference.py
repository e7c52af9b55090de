"""Tasks of inference: every stage alone, on what the pipeline hands it, and the pipeline whole."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from benchmarking.scripted import ScriptedExtractor
from benchmarking.tasks import Task
from benchmarking.workload import Workload, ellipsoid_mesh
from foundpose.features import PatchExtractor
from foundpose.geometry import PerspectiveCrop, pose_deviation
from foundpose.matching import Matcher, SoftPatchMatcher
from foundpose.pipeline import (
    FoundPose,
    HypothesisScorer,
    InlierScore,
    MatchAndSolve,
    PoseEstimates,
    select_query_patches,
)
from foundpose.pnp import PnpProblem, RansacPnp, TemplateStart
from foundpose.refinement import PoseRefiner
from foundpose.retrieval import Retriever, SpatialReranker, TemplateRetriever

Refine = Literal["best", "all"]

YARDSTICK = "yardstick: all blocks"
HOOKED = "extractor"
COARSE = "pipeline, coarse"
REFINED = "pipeline, refined"
REFINED_ALL = "pipeline, all refined"
REFINE_ONE = "refinement of 1 hypothesis"
CANDIDATES = "candidates for re-ranking"
RETRIEVAL = "retrieval"
_WITH_EXTRACTOR = ", with extractor"


class Stages(NamedTuple):
    """The stages but for the extractor, with the settings that fit a workload's sizes.

    Attributes:
        crop: cuts crops that the workload's descriptors belong to.
        retriever: finds templates.
        matcher: matches patches.
        pnp: estimates poses.
        refiner: refines poses; None leaves refinement out.
        epnp: another RANSAC that is only reported, with the paper's minimal solver; None leaves it out.
        scorer: chooses among hypotheses.
        start: gives hypotheses beside RANSAC's; None: none.
    """

    crop: PerspectiveCrop
    retriever: Retriever
    matcher: Matcher
    pnp: RansacPnp
    refiner: PoseRefiner | None
    epnp: RansacPnp | None = None
    scorer: HypothesisScorer = InlierScore()
    start: TemplateStart | None = None

    def pipeline(self, extractor: PatchExtractor, refine: Refine | None = None) -> FoundPose:
        """The stages composed; ``refine`` None for coarse poses."""
        refiner = None if refine is None else self.refiner
        return FoundPose(
            self.crop,
            extractor,
            self.retriever,
            MatchAndSolve(self.matcher, self.pnp, self.scorer, self.start),
            refiner,
            refine or "best",
        ).eval()


def estimate(pipeline: FoundPose, workload: Workload) -> PoseEstimates:
    """Run a pipeline on a workload."""
    meshes = None if pipeline.refiner is None else ellipsoid_mesh()
    return pipeline(
        workload.images,
        workload.K,
        workload.representation,
        workload.masks,
        image_index=workload.image_index,
        meshes=meshes,
    )


def accuracy(estimates: PoseEstimates, workload: Workload) -> dict[str, float]:
    """Share of crops whose pose is found (within 5 degrees and 5 % of the distance), and median errors."""
    truth = workload.T_camera_from_model
    away = torch.linalg.vector_norm(truth[:, :3, 3], dim=1)
    deviation = pose_deviation(estimates.T_camera_from_model, truth, unit=away)
    ok = estimates.valid & (deviation.rotation < 5.0) & (deviation.translation < 0.05)
    return {
        "poses_found": float(ok.float().mean()),
        "median_degrees": float(deviation.rotation.median()),
        "median_distance_share": float(deviation.translation.median()),
    }


def record_calls(
    modules: dict[str, nn.Module], run: Callable[[], PoseEstimates]
) -> tuple[dict[str, list[Any]], PoseEstimates]:
    """Arguments that modules are called with while a pipeline runs, by name, and what comes out of it.

    Args:
        modules: what to watch; one that is not called is left out of the answer.
        run: what to run.
    """
    seen: dict[str, list[Any]] = {}

    def watch(name: str, module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        if kwargs:
            raise RuntimeError(
                f"the pipeline calls {name} with keywords {sorted(kwargs)}; expected positions"
            )
        seen.setdefault(name, list(args))

    handles = [
        module.register_forward_pre_hook(partial(watch, name), with_kwargs=True)
        for name, module in modules.items()
    ]
    try:
        return seen, run()
    finally:
        for handle in handles:
            handle.remove()


def stage_inputs(
    stages: Stages, workload: Workload, refine_all: bool = True
) -> tuple[dict[str, list[Any]], PoseEstimates]:
    """What the pipeline calls each stage with, and what comes out coarse.

    ``refiner`` is called with the proposals of one hypothesis per crop, ``refiner of all`` with those of all
    (left out without ``refine_all``).
    """
    extractor = ScriptedExtractor(workload.sizes, workload.features)
    watched: dict[str, nn.Module] = {
        "extractor": extractor,
        "retriever": stages.retriever,
        "matcher": stages.matcher,
        "pnp": stages.pnp,
        "scorer": stages.scorer,
    }
    if stages.start is not None:
        watched["start"] = stages.start
    kinds: list[tuple[str, Refine]] = [("refiner", "best")]
    if refine_all:
        kinds.append(("refiner of all", "all"))
    with torch.no_grad():
        inputs, coarse = record_calls(watched, partial(estimate, stages.pipeline(extractor), workload))
        for name, refine in kinds:
            if stages.refiner is not None:
                run = partial(estimate, stages.pipeline(extractor, refine), workload)
                inputs |= record_calls({name: stages.refiner}, run)[0]
    return inputs, coarse


def stage_tasks(
    stages: Stages,
    workload: Workload,
    backbones: dict[str, PatchExtractor],
    group: str,
    refine_all: bool = True,
) -> list[Task]:
    """Every stage alone, forward.

    Args:
        stages: the stages.
        workload: what they work on.
        backbones: extractors that run on the crops, by the name of their row.
        group: section of the table.
        refine_all: refine all hypotheses too.
    """
    inputs, coarse = stage_inputs(stages, workload, refine_all)
    representation = workload.representation
    B, h = coarse.templates.index.shape
    (crops,) = inputs["extractor"]
    scripted = ScriptedExtractor(workload.sizes, workload.features)
    features = scripted(crops)
    raw = select_query_patches(features, coarse.crops, scripted)

    task = partial(Task, group, batch_size=B, units=B)
    crop = partial(stages.crop, workload.images, workload.K, workload.masks, image_index=workload.image_index)
    tasks = [task(name, partial(backbone, crops)) for name, backbone in backbones.items()]
    tasks += [
        task("crop", crop),
        task("query patches", partial(select_query_patches, features, coarse.crops, scripted)),
        task("PCA projection", partial(representation.projection, raw.descriptors)),
    ]
    retriever = stages.retriever
    if isinstance(retriever, SpatialReranker):
        retriever = retriever.retriever
    if isinstance(retriever, TemplateRetriever):
        call = partial(
            retriever.bow,
            coarse.query.descriptors,
            coarse.query.valid,
            representation.words,
            representation.idf,
        )
        tasks.append(task("words and bag of words", call, note="a part of retrieval"))
    if retriever is not stages.retriever:
        candidates = partial(retriever, *inputs["retriever"])
        tasks.append(task(CANDIDATES, candidates, note="a part of retrieval"))
    tasks.append(task(RETRIEVAL, partial(stages.retriever, *inputs["retriever"])))
    tasks += [
        task("template gather", partial(representation.gather_templates, coarse.templates.index)),
        task("matching", partial(stages.matcher, *inputs["matcher"])),
        task(
            pnp_name(h),
            partial(stages.pnp, *inputs["pnp"]),
            facts={"solver": stages.pnp.solver, "patches": float(raw.valid.sum() / B)},
        ),
    ]
    if stages.start is not None:
        T = stages.start(*inputs["start"])

        def polish() -> Any:
            return stages.pnp.polish_starts(T.flatten(0, 1), inputs["pnp"][0])

        tasks.append(task("templates' own poses", partial(stages.start, *inputs["start"])))
        tasks.append(task("polish of the templates' poses", polish))
    tasks.append(task("verification", partial(stages.scorer, *inputs["scorer"])))
    if stages.epnp is not None:
        name = f"{pnp_name(h)}, epnp"
        tasks.append(task(name, partial(stages.epnp, *inputs["pnp"]), note="reported only"))
    if stages.refiner is not None:
        tasks.append(task(REFINE_ONE, partial(stages.refiner, *inputs["refiner"])))
        if refine_all:
            tasks.append(task(refine_all_name(h), partial(stages.refiner, *inputs["refiner of all"])))
    return tasks


def pipeline_tasks(
    stages: Stages, workload: Workload, backbone: PatchExtractor | None, group: str, judge: bool = True
) -> list[Task]:
    """The pipeline whole on prepared descriptors, and again with an extractor that is run and not listened to.

    Args:
        stages: the stages.
        workload: what they work on.
        backbone: the extractor; None leaves out what runs it.
        group: section of the table.
        judge: say how good the poses are.
    """
    B = workload.sizes.batch_size
    kinds: list[tuple[str, Refine | None]] = [(COARSE, None)]
    if stages.refiner is not None:
        kinds += [(REFINED, "best"), (REFINED_ALL, "all")]
    tasks = []
    for suffix, extractor in (("", None), (_WITH_EXTRACTOR, backbone)):
        if suffix and extractor is None:
            continue
        scripted = ScriptedExtractor(workload.sizes, workload.features, extractor)
        for name, refine in kinds:
            if suffix and refine == "all":
                continue
            pipeline = stages.pipeline(scripted, refine)
            facts = {}
            if judge and not suffix:
                with torch.no_grad():
                    facts = accuracy(estimate(pipeline, workload), workload)
            call = partial(estimate, pipeline, workload)
            tasks.append(Task(group, name + suffix, call, B, B, facts=facts))
    return tasks


def backward_tasks(
    stages: Stages, workload: Workload, backbones: dict[str, PatchExtractor], group: str
) -> list[Task]:
    """Forward and backward of the stages that have a gradient worth having, and of the whole pipeline."""
    inputs, coarse = stage_inputs(stages, workload)
    B, h = coarse.templates.index.shape
    task = partial(Task, group, batch_size=B, units=B, gradient=True)
    images = _leaf(workload.images)
    (crops,) = inputs["extractor"]
    crops = _leaf(crops)

    def crop() -> Tensor:
        return stages.crop(images, workload.K, workload.masks, image_index=workload.image_index).images

    tasks = [task("crop, w.r.t. images", partial(_gradient, crop, [images]))]
    for name, backbone in backbones.items():

        def describe(backbone: PatchExtractor = backbone) -> Tensor:
            return backbone(crops).patches

        tasks.append(task(f"{name}, w.r.t. images", partial(_gradient, describe, [crops])))
    soft = SoftPatchMatcher(5.0).to(crops.device)
    query, template = (x._replace(descriptors=_leaf(x.descriptors)) for x in inputs["matcher"][:2])

    def match() -> Tensor:
        return soft(query, template).points_model

    both = [query.descriptors, template.descriptors]
    tasks.append(task("soft matching, w.r.t. both descriptors", partial(_gradient, match, both)))
    problem, priority = inputs["pnp"]
    leaves = [_leaf(problem.points_image), _leaf(problem.points_model), _leaf(problem.weights)]
    pnp = stages.pnp

    def solve() -> Tensor:
        given = PnpProblem(leaves[0], leaves[1], problem.K, problem.valid, leaves[2])
        return pnp(given, priority).T_camera_from_model

    tasks.append(task(f"{pnp_name(h)}, w.r.t. points and weights", partial(_gradient, solve, leaves)))
    if stages.refiner is not None:
        refiner = stages.refiner
        for name, key in ((REFINE_ONE, "refiner"), (refine_all_name(h), "refiner of all")):
            proposals, observation = inputs[key]
            patches = _leaf(observation.features.patches)
            given = observation._replace(features=observation.features._replace(patches=patches))

            def refine(proposals: Any = proposals, given: Any = given) -> Tensor:
                return refiner(proposals, given).T_crop_from_model

            tasks.append(task(f"{name}, w.r.t. the feature map", partial(_gradient, refine, [patches])))
        features = _leaf(workload.features)
        pipeline = stages.pipeline(ScriptedExtractor(workload.sizes, features), "best")

        def whole() -> Tensor:
            return estimate(pipeline, workload).T_camera_from_model

        tasks.append(task(f"{REFINED}, w.r.t. the feature map", partial(_gradient, whole, [features])))
    return tasks


def pnp_name(hypotheses: int) -> str:
    """Name of the row of PnP."""
    return f"PnP of {hypotheses} hypotheses"


def refine_all_name(hypotheses: int) -> str:
    """Name of the row in which all hypotheses are refined."""
    return f"refinement of {hypotheses} hypotheses"


def _leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()


def _gradient(run: Callable[[], Tensor], leaves: list[Tensor]) -> tuple[Tensor, ...]:
    """Run something and differentiate the sum of squares of what comes out."""
    return torch.autograd.grad(run().square().sum(), leaves)

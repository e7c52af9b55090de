"""An evaluation from its Hydra config: what the apps that evaluate share."""

import logging
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from hydra.utils import instantiate
from omegaconf import DictConfig

from foundpose.bop import (
    BopDataset,
    PoseResult,
    Scores,
    Target,
    best_of_targets,
    check_functions,
    check_times,
    detection_scores,
    read_results,
    result_file_name,
    score_pose_detections,
    score_results,
    write_results,
)
from foundpose.config import Method, build_detector, build_method, claim_run_folder, wanted_objects
from foundpose.evaluation.data import PoseDataModule
from foundpose.evaluation.detecting import Pictures, detect_dataset
from foundpose.evaluation.module import PoseEvaluation, estimate_dataset
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import to_results
from foundpose.evaluation.reliability import dataset_reliability
from foundpose.evaluation.report import Estimated, all_records, in_words, merge_shards, timing, unanswered
from foundpose.utils.files import write_json
from foundpose.utils.progress import ProgressBars
from foundpose.visualization.reliability import save_reliability_diagram


def run_evaluation(cfg: DictConfig, output: Path) -> Scores | None:
    """Estimate what is not estimated yet, then write results, scores and times to the run's folder.

    With ``cfg.results`` the poses of that file are scored instead; with ``cfg.detections`` its 2D detections.

    Args:
        cfg: as ``conf/evaluate.yaml``.
        output: the run's folder; in a run of several processes each gets it, and the first writes the results.

    Returns:
        The scores of poses; None in all processes but the first, and for a split without ground truth.

    Raises:
        ValueError: settings or files that make no sense; the message says which.
        FileNotFoundError: a missing file.
    """
    check_functions(list(cfg.errors))
    dataset: BopDataset = instantiate(cfg.data)
    wanted = wanted_objects(cfg, dataset)
    if cfg.detections is not None:
        _score_detections(cfg, dataset, wanted, output)
        return None
    estimated = records = None
    if cfg.results is not None:
        results = read_results(cfg.results)
        check_times(results)
    else:
        report = None if cfg.report is None else instantiate(cfg.report)
        estimated = _estimate(cfg, dataset, wanted, output)
        if estimated is None:
            return None
        records = estimated.records
        results = best_of_targets(to_results(records), dataset.targets())
        path = output / result_file_name(cfg.method, dataset.name, cfg.data.split)
        write_results(path, results)
        print(f"{len(records)} instances, {sum(r['valid'] for r in records)} with a pose; written to {path}")
    scores = _score(cfg, dataset, results, records, wanted, output)
    if estimated is not None and report is not None:
        report(output / "report.html", estimated, scores)
        print(f"report: {output / 'report.html'}")
    return scores


def _estimate(cfg: DictConfig, dataset: BopDataset, wanted: list[int], output: Path) -> Estimated | None:
    """The estimates of all instances, in the first process; None in the others."""
    masks = instantiate(cfg.masks)
    method = build_method(cfg)
    objects = DatasetObjects(dataset, method.store, cfg.memory_limit, color=cfg.color)
    pictures = instantiate(cfg.pictures)
    if "path" in cfg.masks and cfg.masks.path is None:
        masks = partial(masks, path=_detect(cfg, method, objects, pictures, wanted, output))
    data: PoseDataModule = instantiate(
        cfg.data_module,
        dataset=dataset,
        masks=masks,
        objects=objects,
        folder=output,
        pictures=pictures,
        object_ids=wanted,
        max_images=cfg.max_images,
    )
    found = data.instances
    claim_run_folder(output, cfg)
    logging.getLogger("pytorch_lightning.utilities.rank_zero").setLevel(logging.WARNING)
    trainer: pl.Trainer = instantiate(cfg.trainer, default_root_dir=output)
    module: PoseEvaluation = instantiate(
        cfg.evaluation, pipeline=method.pipeline, objects=objects, folder=output
    )
    with warnings.catch_warnings():
        # Reading is a small part of the time; num_workers is there for those who want it.
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*")  # Lightning's own
        estimate_dataset(trainer, module, data)
    if not trainer.is_global_zero:
        return None

    done = merge_shards(output, data.batches)
    write_json(output / "timing.json", timing(done, trainer.strategy.root_device))
    write_json(output / "memory.json", memory(objects, sorted({i.obj_id for i in found})))
    records = all_records(done)
    write_json(output / "estimates.json", records)
    # In the order of the records.
    instances = sorted(found, key=lambda i: (i.scene_id, i.im_id, i.obj_id))
    device = trainer.strategy.root_device
    return Estimated(dataset, data.pictures, objects, method.pipeline, device, instances, records)


def _detect(
    cfg: DictConfig,
    method: Method,
    objects: DatasetObjects,
    pictures: Pictures,
    wanted: list[int],
    output: Path,
) -> Path:
    """The run's own detections."""
    claim_run_folder(output, cfg)
    detector = build_detector(cfg, method.onboarder.extractor)
    objects.onboard(wanted, ProgressBars)
    images = objects.dataset.images()[: cfg.max_images]
    return detect_dataset(detector, objects, pictures, images, wanted, output, ProgressBars())


def memory(objects: DatasetObjects, ids: list[int]) -> dict[str, dict[str, int]]:
    """Bytes of the objects' representations by part, by object id."""
    return {str(obj_id): objects.representations([obj_id])[0].memory_bytes() for obj_id in ids}


def _score(
    cfg: DictConfig,
    dataset: BopDataset,
    results: list[PoseResult],
    records: list[dict[str, Any]] | None,
    wanted: list[int],
    output: Path,
) -> Scores | None:
    """Write scores.json and print the table, and what has no estimate; a split without ground truth has no scores."""
    scenes = sorted({scene_id for scene_id, _ in dataset.images()})
    without = [scene_id for scene_id in scenes if not dataset.has_ground_truth(scene_id)]
    if without:
        reason = f"{len(without)} of {len(scenes)} scenes in {dataset.split} have no scene_gt.json"
        missing = unanswered(_targets(cfg, dataset.targets(), dataset, wanted), results, records)
        content = {"computed": False, "reason": reason, "without_estimate": missing}
        write_json(output / "scores.json", content)
        print(f"no scores: {reason}")
        print(in_words(missing))
        return None
    targets = _targets(cfg, dataset.localization_targets(), dataset, wanted)
    scores = score_results(
        dataset,
        results,
        errors=tuple(cfg.errors),
        targets=targets,
        progress=ProgressBars("score"),
    )
    missing = unanswered(targets, results, records)
    content = scores.to_json() | {"without_estimate": missing}
    print(scores.table())
    if any(target.obj_id is None for target in dataset.targets()):
        precision = score_pose_detections(
            dataset, results, dataset.images()[: cfg.max_images], wanted, progress=ProgressBars("score")
        )
        content["detection_6d"] = precision.to_json()
        print(f"6D detection:\n{precision.table()}")
    trust = None if records is None else dataset_reliability(dataset, records)
    if trust is not None:
        content["confidence"] = trust.to_json()
        bins = (trust.probability.tolist(), trust.share.tolist(), trust.count.tolist())
        save_reliability_diagram(output / "reliability.png", *bins)
        print(trust.table())
    write_json(output / "scores.json", content)
    print(in_words(missing))
    return scores


def _score_detections(cfg: DictConfig, dataset: BopDataset, wanted: list[int], output: Path) -> None:
    """Write detection_scores.json and print the table."""
    scores = detection_scores(
        dataset, cfg.detections, images=dataset.images()[: cfg.max_images], object_ids=wanted
    )
    write_json(output / "detection_scores.json", scores.to_json())
    print(scores.table())


def _targets(cfg: DictConfig, targets: list[Target], dataset: BopDataset, wanted: list[int]) -> list[Target]:
    """The part of the targets that a run is about."""
    images = set(dataset.images()[: cfg.max_images])
    return [t for t in targets if t.obj_id in (None, *wanted) and (t.scene_id, t.im_id) in images]

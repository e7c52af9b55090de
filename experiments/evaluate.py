"""Poses and scores of a whole BOP dataset: detections in, results.csv, scores.json and timing.json out.

python experiments/evaluate.py data=lmo data.root=/path/to/lmo masks=cnos
python experiments/evaluate.py data=lmo data.root=/path/to/lmo results=submission_lmo-test.csv
"""

import logging
import warnings
from pathlib import Path

import hydra
import pytorch_lightning as pl
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from foundpose.bop import (
    BopDataset,
    PoseResult,
    Target,
    check_functions,
    read_results,
    result_file_name,
    score_results,
    write_results,
)
from foundpose.config import build_method, claim_run_folder, clear_errors, wanted_objects
from foundpose.evaluation import (
    PoseDataModule,
    PoseEvaluation,
    all_records,
    estimate_dataset,
    merge_shards,
    timing,
)
from foundpose.io import write_json
from foundpose.objects import DatasetObjects
from foundpose.progress import ProgressBars
from foundpose.records import best_results, to_results

# Settings that may change when a run is resumed: they change no pose.
MAY_CHANGE = ("device", "trainer", "errors", "memory_limit", "representations", "data_module.num_workers")


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    """Estimate what is not estimated yet, then write results, scores and times to the run's folder."""
    output = Path(HydraConfig.get().runtime.output_dir)
    with clear_errors():
        check_functions(list(cfg.errors))
        dataset: BopDataset = instantiate(cfg.data)
        wanted = wanted_objects(cfg, dataset)
        if cfg.results is not None:
            score(cfg, dataset, read_results(cfg.results), targets_of(cfg, dataset, wanted), output)
        else:
            evaluate(cfg, dataset, wanted, output)


def evaluate(cfg: DictConfig, dataset: BopDataset, wanted: list[int], output: Path) -> None:
    """Poses of the dataset, then their scores."""
    masks = instantiate(cfg.masks)
    method = build_method(cfg)
    objects = DatasetObjects(dataset, method.store, cfg.memory_limit)
    data: PoseDataModule = instantiate(
        cfg.data_module,
        dataset=dataset,
        masks=masks,
        objects=objects,
        folder=output,
        pictures=instantiate(cfg.pictures),
        object_ids=wanted,
        max_images=cfg.max_images,
    )
    batches = data.batches
    logging.getLogger("pytorch_lightning.utilities.rank_zero").setLevel(logging.WARNING)
    claim_run_folder(output, cfg, MAY_CHANGE)
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
        return

    done = merge_shards(output, batches)
    write_json(output / "timing.json", timing(done, trainer.strategy.root_device))
    records = all_records(done)
    write_json(output / "estimates.json", records)
    results = best_results(to_results(records), dataset.targets())
    path = output / result_file_name(cfg.method, dataset.root.name, cfg.data.split)
    write_results(path, results)
    print(f"{len(records)} instances, {sum(r['valid'] for r in records)} with a pose; written to {path}")
    score(cfg, dataset, results, targets_of(cfg, dataset, wanted), output)


def targets_of(cfg: DictConfig, dataset: BopDataset, wanted: list[int]) -> list[Target] | None:
    """The part of the targets that a run is about, or None for all; read only where a run is about a part."""
    if cfg.objects is None and cfg.max_images is None:
        return None
    images = set(dataset.images()[: cfg.max_images])
    targets = dataset.localization_targets()
    return [t for t in targets if t.obj_id in wanted and (t.scene_id, t.im_id) in images]


def score(
    cfg: DictConfig,
    dataset: BopDataset,
    results: list[PoseResult],
    targets: list[Target] | None,
    output: Path,
) -> None:
    """Write scores.json and print the table; a split without ground truth has no scores."""
    scenes = sorted({scene_id for scene_id, _ in dataset.images()})
    without = [scene_id for scene_id in scenes if not dataset.has_ground_truth(scene_id)]
    if without:
        reason = f"{len(without)} of {len(scenes)} scenes in {dataset.split} have no scene_gt.json"
        write_json(output / "scores.json", {"computed": False, "reason": reason})
        print(f"no scores: {reason}")
        return
    scores = score_results(
        dataset, results, errors=tuple(cfg.errors), targets=targets, progress=ProgressBars("score")
    )
    write_json(output / "scores.json", scores.to_json())
    print(scores.table())


if __name__ == "__main__":
    main()

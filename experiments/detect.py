"""Find the objects of a BOP dataset in its pictures: the file of detections that masks=cnos reads, and its precision.

python experiments/detect.py data=lmo data.root=/path/to/lmo
python experiments/evaluate.py data=lmo data.root=/path/to/lmo masks=cnos masks.path=…/detections.json
"""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from foundpose.bop import BopDataset, decode_segmentation, detection_scores, read_json
from foundpose.config import build_detector, build_method, claim_run_folder, clear_errors, wanted_objects
from foundpose.evaluation.detecting import detect_dataset
from foundpose.evaluation.objects import DatasetObjects
from foundpose.utils.files import write_atomically, write_json
from foundpose.utils.progress import ProgressBars
from foundpose.visualization import draw_instances, to_pil


@hydra.main(version_base="1.3", config_path="../conf", config_name="detect")
def main(cfg: DictConfig) -> None:
    """Write detections.json, overlays and, where there is ground truth, detection_scores.json to the run's folder."""
    output = Path(HydraConfig.get().runtime.output_dir)
    with clear_errors():
        dataset: BopDataset = instantiate(cfg.data)
        ids, images = wanted_objects(cfg, dataset), dataset.images()[: cfg.max_images]
        method = build_method(cfg)
        detector = build_detector(cfg, method.onboarder.extractor)
        pictures = instantiate(cfg.pictures)
        claim_run_folder(output, cfg, ("max_images",))  # images are searched one by one
        objects = DatasetObjects(dataset, method.store, color=cfg.color)
        objects.onboard(ids, ProgressBars)
        path = detect_dataset(detector, objects, pictures, images, ids, output, ProgressBars())
        entries = read_json(path)
        for scene_id, im_id in images[:: cfg.overlays] if cfg.overlays else ():
            mine = [e for e in entries if (e["scene_id"], e["image_id"]) == (scene_id, im_id)]
            best = {e["category_id"]: e for e in sorted(mine, key=lambda e: float(e["score"]))}
            drawn = draw_instances(
                dataset.image(scene_id, im_id),
                [decode_segmentation(e["segmentation"]) for e in best.values()],
                [f"{dataset.object_name(e['category_id'])} {e['score']:.2f}" for e in best.values()],
            )
            write_atomically(output / "overlays" / f"{scene_id:06d}_{im_id:06d}.png", to_pil(drawn).save)
        print(f"{len(entries)} detections in {len(images)} images; written to {path}")
        if all(dataset.has_ground_truth(scene_id) for scene_id, _ in images):
            scores = detection_scores(dataset, path, images=images, object_ids=ids)
            write_json(output / "detection_scores.json", scores.to_json())
            print(scores.table())


if __name__ == "__main__":
    main()

"""Estimate poses in pictures of your own, or in those of a BOP dataset. Without a mask, objects are found first.

python experiments/estimate.py image=photo.jpg meshes=[cup.ply,box.ply] intrinsics=[fx,fy,cx,cy]
python experiments/estimate.py image=photo.jpg mesh=cup.ply mask=mask.png intrinsics=[fx,fy,cx,cy]
python experiments/estimate.py data=lmo data.root=/path/to/lmo masks=gt extractor=dense_sift
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from kornia.geometry.calibration import undistort_image
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from foundpose.bop import (
    BopDataset,
    Instance,
    best_of_targets,
    read_image,
    read_mask,
    result_file_name,
    write_results,
)
from foundpose.config import Method, build_method, claim_run_folder, clear_errors, wanted_objects
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import (
    add_image_times,
    instance_record,
    pose_records,
    to_results,
)
from foundpose.evaluation.report import in_words, unanswered
from foundpose.geometry import Camera, boxes_from_xywh, check_camera, masks_from_boxes, read_camera
from foundpose.pipeline.results import PoseEstimates, PoseStatus
from foundpose.rendering import Mesh, load_mesh
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_atomically, write_json
from foundpose.utils.progress import ProgressBars, say, track
from foundpose.utils.timing import StageTimer
from foundpose.visualization.scene import write_scene


@hydra.main(version_base="1.3", config_path="../conf", config_name="estimate")
def main(cfg: DictConfig) -> None:
    """Estimate and write JSON, BOP CSV and overlays to the run's folder."""
    output = Path(HydraConfig.get().runtime.output_dir)
    with clear_errors():
        if cfg.image is not None and cfg.mask is None and cfg.box is None:
            from finding import find_in_pictures  # which reads views with what is below

            if not find_in_pictures(cfg, output):
                sys.exit(1)
        elif cfg.image is not None:
            estimate_picture(cfg, output)
        else:
            estimate_dataset(cfg, output)


def estimate_picture(cfg: DictConfig, output: Path) -> None:
    """One picture, one mesh, one mask or box."""
    for name in ("image", "mesh", "intrinsics"):
        if cfg[name] is None:
            raise ValueError(f"for a picture of your own give {name}=… too")
    image, K, mask = read_view(cfg)
    mesh = load_mesh(cfg.mesh, cfg.color)
    claim_run_folder(output, cfg)
    method = build_method(cfg)
    name = Path(cfg.mesh).stem
    representation = method.store.get(mesh, name, ProgressBars(name)).to(cfg.device)
    index = torch.zeros(1, dtype=torch.int64)
    shown = [(mesh, representation)]
    estimates, seconds = run_pipeline(method, cfg, image, K, mask[None], shown, index)
    facts = pose_records(estimates)[0] | {"mesh": str(cfg.mesh), "image": str(cfg.image), "time": seconds}
    write_json(output / "estimate.json", facts)
    write_results(output / "results.csv", to_results([facts | {"scene_id": 0, "im_id": 0, "obj_id": 0}]))
    write_atomically(output / "overlay.png", estimates.draw(0).save)
    if facts["valid"]:
        write_scene(output / "scene.glb", image, K, [(mesh, estimates.T_camera_from_model[0])])
    print(json.dumps(facts, indent=1))
    print(f"written to {output}")
    if not facts["valid"]:
        say(f"not found: {why_not(facts, cfg.min_confidence)}")
        sys.exit(1)


def why_not(facts: dict[str, Any], min_confidence: float) -> str:
    """Why an object counts as not found."""
    if facts["status"] != PoseStatus.UNLIKELY.name:
        return str(facts["status"])
    return (
        f"{facts['status']}, the pose is right with a probability of {facts['probability']:.2f} only "
        f"(min_confidence={min_confidence})"
    )


def read_view(cfg: DictConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The picture (3, H, W), its intrinsics (3, 3) and the mask (H, W), without lens distortion."""
    check_words(cfg)
    image = read_image(cfg.image, cfg.background)
    size = (int(image.shape[1]), int(image.shape[2]))
    camera = read_intrinsics(cfg, size)
    mask = read_region(cfg, size)
    if camera.distortion:
        image, mask = undistort(image, mask, camera.K, camera.distortion)
    return image, camera.K, mask


def check_words(cfg: DictConfig) -> None:
    """Raise ValueError where a key that names a file or a colour holds something else."""
    for name in ("image", "mask", "mesh", "background"):
        if not isinstance(cfg[name], str | None) or (name == "background" and cfg[name] is None):
            what = "a colour such as black" if name == "background" else "the name of a file"
            raise ValueError(f"{name} must be {what}, got {cfg[name]}; put a name that is a number in quotes")
    if not isinstance(cfg.largest_component, bool):
        raise ValueError(f"largest_component must be true or false, got {cfg.largest_component}")


def read_intrinsics(cfg: DictConfig, size: tuple[int, int]) -> Camera:
    """The camera of a picture (height, width), with the distortion of the config or that of its file."""
    given = cfg.intrinsics
    camera = read_camera(OmegaConf.to_container(given) if OmegaConf.is_config(given) else given)
    check_camera(camera.K, size, camera.size)
    if cfg.distortion is not None:
        camera = camera._replace(distortion=numbers(cfg, "distortion", "[k1,k2,p1,p2,…]"))
    if len(camera.distortion) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(f"distortion must have 4, 5, 8, 12 or 14 coefficients, got {len(camera.distortion)}")
    return camera


def read_region(cfg: DictConfig, size: tuple[int, int]) -> Tensor:
    """The mask (H, W) that the config's mask or box says."""
    if (cfg.mask is None) == (cfg.box is None):
        raise ValueError("give either mask=… (a picture) or box=[x,y,width,height]")
    if cfg.mask is not None:
        return read_mask(cfg.mask, size, cfg.largest_component)
    box = numbers(cfg, "box", "[x,y,width,height]", 4)
    mask = masks_from_boxes(boxes_from_xywh(torch.tensor([box])), *size)[0]
    if not bool(mask.any()):
        raise ValueError(f"box {box} holds no pixel of the image, which is {size[1]}x{size[0]} px")
    return mask


def numbers(cfg: DictConfig, name: str, form: str, count: int | None = None) -> list[float]:
    """A list of numbers of the config."""
    node = cfg[name]
    value = list(node) if OmegaConf.is_list(node) else node
    right = isinstance(value, list) and all(isinstance(v, int | float) for v in value)
    if not right or count not in (None, len(value)):
        raise ValueError(f"{name} must be {form}, got {value}")
    return [float(v) for v in value]


def numbers_of_instances(cfg: DictConfig, meshes: int) -> int | list[int] | None:
    """How many instances of each mesh a picture has at most; None for as many as there are."""
    value = list(cfg.instances) if OmegaConf.is_list(cfg.instances) else cfg.instances
    counts = value if isinstance(value, list) else [1 if value is None else value]
    right = all(type(count) is int and count >= 1 for count in counts)
    if not right or (isinstance(value, list) and len(value) != meshes):
        raise ValueError(
            f"instances must be a number of at least 1, one for each of the {meshes} meshes, or null; got {value}"
        )
    return value


def undistort(image: Tensor, mask: Tensor, K: Tensor, distortion: list[float]) -> tuple[Tensor, Tensor]:
    """Undo lens distortion of a picture (3, H, W) and its mask; the intrinsics stay the same."""
    stacked = torch.cat([image, mask[None].to(image.dtype)])
    straight = undistort_image(stacked[None], K[None], torch.tensor([distortion]))[0]
    return straight[:3], straight[3] > 0.5


def estimate_dataset(cfg: DictConfig, output: Path) -> None:
    """All instances of a BOP dataset, image by image; finished images are kept in ``images/`` and not repeated."""
    dataset: BopDataset = instantiate(cfg.data)
    instances: list[Instance] = instantiate(cfg.masks)(dataset)
    wanted = wanted_objects(cfg, dataset)
    by_image: dict[tuple[int, int], list[Instance]] = defaultdict(list)
    for instance in instances:
        if instance.obj_id in wanted:
            by_image[instance.scene_id, instance.im_id].append(instance)
    images = sorted(by_image)[: cfg.max_images]
    if not images:
        raise ValueError(f"no instance of the objects {sorted(wanted)} in {dataset.targets_path}")
    claim_run_folder(output, cfg, ("max_images",))  # images are estimated one by one

    method = build_method(cfg)
    pictures = instantiate(cfg.pictures)
    objects = DatasetObjects(dataset, method.store, color=cfg.color)
    objects.onboard(sorted({i.obj_id for key in images for i in by_image[key]}), ProgressBars)

    entries: list[dict[str, Any]] = []
    for position, (scene_id, im_id) in enumerate(track(images, "images")):
        path = output / "images" / f"{scene_id:06d}_{im_id:06d}.json"
        if not path.is_file():
            members = by_image[scene_id, im_id]
            K = dataset.intrinsics(scene_id, im_id).float()
            image = pictures(dataset, scene_id, im_id)
            masks = torch.stack([instance.mask(dataset) for instance in members])
            ids = sorted({instance.obj_id for instance in members})
            index = torch.tensor([ids.index(instance.obj_id) for instance in members])
            representations = objects.representations(ids, cfg.device)
            shown = list(zip(map(objects.mesh, ids), representations, strict=True))
            estimates, seconds = run_pipeline(method, cfg, image, K, masks, shown, index)
            for i, instance in enumerate(members if cfg.overlays and position % cfg.overlays == 0 else ()):
                name = f"{scene_id:06d}_{im_id:06d}_{instance.obj_id:06d}_{i}.png"
                write_atomically(output / "overlays" / name, estimates.draw(i).save)
            write_json(
                path,
                [
                    instance_record(instance) | pose | {"seconds": seconds / len(members)}
                    for instance, pose in zip(members, pose_records(estimates), strict=True)
                ],
            )
        entries += json.loads(path.read_text())

    add_image_times(entries)
    write_json(output / "estimates.json", entries)
    csv = output / result_file_name(cfg.method, dataset.name, cfg.data.split)
    results = best_of_targets(to_results(entries), dataset.targets())
    write_results(csv, results)
    valid = sum(entry["valid"] for entry in entries)
    print(f"{len(entries)} instances in {len(images)} images, {valid} with a pose; written to {csv}")
    targets = [t for t in dataset.targets() if t[:2] in images and t.obj_id in (None, *wanted)]
    print(in_words(unanswered(targets, results, entries)))


def run_pipeline(
    method: Method,
    cfg: DictConfig,
    image: Tensor,
    K: Tensor,
    masks: Tensor,
    objects: list[tuple[Mesh, ObjectRepresentation]],
    object_index: Tensor,
) -> tuple[PoseEstimates, float]:
    """Poses of several masks of one image, without the improbable ones, and the seconds that they took."""
    device = cfg.device
    with torch.no_grad(), StageTimer({"pipeline": method.pipeline}) as timer:
        estimates = method.pipeline(
            image[None].to(device),
            K[None].to(device),
            [representation for _, representation in objects],
            masks=masks.to(device),
            image_index=torch.zeros(len(masks), dtype=torch.int64, device=device),
            object_index=object_index.to(device),
            meshes=[mesh for mesh, _ in objects],
        )
    return estimates.withhold(cfg.min_confidence), timer.seconds["pipeline"]


if __name__ == "__main__":
    main()

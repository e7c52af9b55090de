"""Objects found, with their poses, in pictures of one's own: a file, a folder or a video."""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch import Tensor

from estimate import check_words, numbers_of_instances, read_intrinsics, undistort
from foundpose.bop import read_image, write_results
from foundpose.config import build_detector, build_method, claim_run_folder
from foundpose.evaluation.page import thumbnail, write_pictures_report
from foundpose.evaluation.records import pose_records, to_results
from foundpose.pipeline import DetectAndEstimate, FoundInstances
from foundpose.pipeline.figure import ObjectView
from foundpose.rendering import Mesh, RaycastRenderer, load_mesh
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_atomically, write_json
from foundpose.utils.progress import ProgressBars, say, track
from foundpose.utils.timing import StageTimer
from foundpose.visualization import REFINED, draw_instances, to_pil

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm"}
VIDEOS = {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"}


def find_in_pictures(cfg: DictConfig, output: Path) -> bool:
    """Find the meshes' objects in all pictures; a picture that is done is not repeated.

    Returns:
        Whether anything was found.
    """
    check_words(cfg)
    for name in ("image", "intrinsics"):
        if cfg[name] is None:
            raise ValueError(f"for a picture of your own give {name}=… too")
    paths = _mesh_paths(cfg)
    instances = numbers_of_instances(cfg, len(paths))
    if type(cfg.step) is not int or cfg.step < 1:
        raise ValueError(f"step must be a whole number of at least 1, got {cfg.step}")
    source = Path(cfg.image)
    names = _names(source)
    meshes = [load_mesh(path, cfg.color) for path in paths]
    claim_run_folder(output, cfg, ("step",))
    method = build_method(cfg)
    detector = build_detector(cfg, method.onboarder.extractor)
    finder: DetectAndEstimate = instantiate(
        cfg.finder, detector=detector, pipeline=method.pipeline, min_probability=cfg.min_confidence
    ).eval()
    objects = [
        method.store.get(mesh, path.stem, ProgressBars(path.stem)).to(cfg.device)
        for mesh, path in zip(meshes, paths, strict=True)
    ]
    entries: list[dict[str, Any]] = []
    total = None if names is None else len(range(0, len(names), cfg.step))
    for number, name, image in track(_pictures(cfg, source, names), "pictures", total):
        file = output / "pictures" / f"{name}.json"
        if not file.is_file():
            straight, K = _straight(cfg, image)
            with torch.no_grad(), StageTimer({"finder": finder}) as timer:
                found = finder(
                    straight[None].to(cfg.device), K[None].to(cfg.device), objects, instances, meshes=meshes
                )
            records = [] if found is None else _records(found, paths)
            facts = {"picture": name, "scene_id": 0, "im_id": number, "time": timer.seconds["finder"]}
            drawn = _overlay(straight, K, found, meshes, records)
            write_atomically(output / "overlays" / f"{name}.png", to_pil(drawn).save)
            if found is not None:
                _draw(output / "figures", name, straight, K, found, objects)
            write_json(file, [facts | record for record in records])
        entries += json.loads(file.read_text(encoding="utf-8"))
    write_json(output / "estimates.json", entries)
    write_results(output / "results.csv", to_results(entries))
    _write_report(output, entries, cfg.report)
    print(json.dumps(entries, indent=1))
    print(f"{len(entries)} instances found; written to {output}")
    for path in paths:
        if not any(entry["mesh"] == str(path) for entry in entries):
            say(f"not found: {path}")
    return bool(entries)


def _draw(
    folder: Path,
    name: str,
    image: Tensor,
    K: Tensor,
    found: FoundInstances,
    objects: list[ObjectRepresentation],
) -> None:
    """How each pose of a picture came about, and a small picture of each."""
    for i, T in enumerate(found.estimates.T_camera_from_model.cpu()):
        write_atomically(folder / f"{name}_{i}.webp", found.estimates.draw(i).save)
        view = ObjectView(objects[int(found.detections.object_index[i])], None)
        small = thumbnail(image, K, found.detections.masks[i].cpu() > 0.5, view, [(REFINED, T)])
        write_atomically(folder / f"{name}_{i}_small.webp", small.save)


def _write_report(output: Path, entries: list[dict[str, Any]], limits: DictConfig) -> None:
    """report.html with all instances; the worst have a figure."""
    counts: Counter[str] = Counter()
    stems = []
    for entry in entries:
        stems.append(output / "figures" / f"{entry['picture']}_{counts[entry['picture']]}")
        counts.update([entry["picture"]])
    worst = sorted(range(len(entries)), key=lambda k: entries[k]["score"])
    write_pictures_report(
        output / "report.html",
        [entry | {"image": entry["picture"]} for entry in entries],
        {k: Image.open(f"{stems[k]}_small.webp") for k in worst[: limits.thumbnails]},
        {k: Image.open(f"{stems[k]}.webp") for k in worst[: limits.figures]},
    )


def _mesh_paths(cfg: DictConfig) -> list[Path]:
    """The files of the meshes."""
    given = cfg.meshes if cfg.mesh is None else [cfg.mesh]
    if cfg.mesh is not None and cfg.meshes is not None:
        raise ValueError("give either mesh=cup.ply or meshes=[cup.ply,box.ply], not both")
    paths = list(given) if OmegaConf.is_list(given) or isinstance(given, list) else given
    if not isinstance(paths, list) or not paths or not all(isinstance(path, str) for path in paths):
        raise ValueError(f"meshes must be a list of files, as in meshes=[cup.ply,box.ply]; got {given}")
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) < len(stems):
        raise ValueError(f"meshes must have different names, got {stems}")
    return [Path(path) for path in paths]


def _names(source: Path) -> list[str] | None:
    """Files of the pictures; None for a video."""
    if source.is_dir():
        names = sorted(path.name for path in source.iterdir() if path.suffix.lower() in PICTURES)
        if not names:
            raise FileNotFoundError(f"no picture in {source}: none of its files ends in {sorted(PICTURES)}")
        stems = Counter(Path(name).stem for name in names)
        twice = sorted(name for name in names if stems[Path(name).stem] > 1)
        if twice:
            raise ValueError(f"results are named after the pictures, and {twice} have one name: rename some")
        return names
    return None if source.suffix.lower() in VIDEOS else [source.name]


def _pictures(cfg: DictConfig, source: Path, names: list[str] | None) -> Iterator[tuple[int, str, Tensor]]:
    """Number, name and picture (3, H, W), every ``step``-th."""
    if names is None:
        for number, frame in _frames(source, cfg.step):
            yield number, f"{source.stem}_{number:06d}", frame
        return
    folder = source if source.is_dir() else source.parent
    for number in range(0, len(names), cfg.step):
        yield number, Path(names[number]).stem, read_image(folder / names[number], cfg.background)


def _frames(path: Path, step: int) -> Iterator[tuple[int, Tensor]]:
    """Every ``step``-th frame of a video, and its number."""
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise ValueError(f"to read {path}, a video: pip install 'foundpose[video]' (OpenCV)") from error
    if not path.is_file():
        raise FileNotFoundError(f"no video at {path}")
    video = cv2.VideoCapture(str(path))
    number = 0
    while video.grab():
        if number % step == 0:
            _, frame = video.retrieve()
            yield number, torch.from_numpy(frame[..., ::-1].copy()).permute(2, 0, 1).float() / 255
        number += 1
    if number == 0:
        raise ValueError(f"{path} is not a video that OpenCV can read")


def _straight(cfg: DictConfig, image: Tensor) -> tuple[Tensor, Tensor]:
    """The picture without lens distortion, and its intrinsics."""
    camera = read_intrinsics(cfg, (int(image.shape[1]), int(image.shape[2])))
    if camera.distortion:
        image, _ = undistort(image, torch.zeros_like(image[0], dtype=torch.bool), camera.K, camera.distortion)
    return image, camera.K


def _records(found: FoundInstances, paths: list[Path]) -> list[dict[str, Any]]:
    """What is written of each instance."""
    records = []
    for i, pose in enumerate(pose_records(found.estimates)):
        label = int(found.detections.object_index[i])
        facts = {"mesh": str(paths[label]), "obj_id": label + 1}
        scores = {"score": float(found.score[i]), "detection_score": float(found.detections.score[i])}
        records.append(facts | pose | scores)
    return records


def _overlay(
    image: Tensor, K: Tensor, found: FoundInstances | None, meshes: list[Mesh], records: list[dict[str, Any]]
) -> Tensor:
    """The picture with the outlines of all instances under their poses, names and scores."""
    if found is None:
        return image
    renderer, size = RaycastRenderer(supersampling=1), (int(image.shape[1]), int(image.shape[2]))
    masks = [
        renderer(meshes[record["obj_id"] - 1], T[None].float().cpu(), K[None].float(), size).mask[0]
        for record, T in zip(records, found.estimates.T_camera_from_model, strict=True)
    ]
    return draw_instances(image, masks, [f"{Path(r['mesh']).stem} {r['score']:.2f}" for r in records])

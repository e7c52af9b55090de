"""Detections of a dataset's objects, in the format of the BOP'23 default detections."""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from foundpose.bop import BopDataset, encode_segmentation
from foundpose.detection import Detections, Detector
from foundpose.evaluation.objects import DatasetObjects
from foundpose.geometry import boxes_from_masks
from foundpose.onboarding.onboarder import Progress
from foundpose.utils.files import write_json

Pictures = Callable[[BopDataset, int, int], Tensor]


def detect_dataset(
    detector: Detector,
    objects: DatasetObjects,
    pictures: Pictures,
    images: Sequence[tuple[int, int]],
    object_ids: Sequence[int],
    folder: Path,
    progress: Progress | None = None,
) -> Path:
    """Find objects in the pictures of a dataset.

    Every picture is searched for all objects, whichever its targets name. A picture's detections are kept in a file
    of their own as soon as they are there, and a run that goes on does not repeat it.

    Args:
        detector: finds them.
        objects: the dataset's objects; missing representations must have been made.
        pictures: makes the picture of an image.
        images: (scene_id, im_id) of the pictures.
        object_ids: what to look for.
        folder: the run's folder.
        progress: called with ("detect", done, total).

    Returns:
        The file ``detections.json`` in the folder.
    """
    dataset = objects.dataset
    ids = sorted(object_ids)
    # An extractor may have neither parameters nor buffers.
    held = (*detector.parameters(), *detector.buffers())
    device = held[0].device if held else torch.device("cpu")
    representations = objects.representations(ids, device)
    entries: list[dict[str, Any]] = []
    for done, (scene_id, im_id) in enumerate(images, start=1):
        path = folder / "detections" / f"{scene_id:06d}_{im_id:06d}.json"
        if not path.is_file():
            image = pictures(dataset, scene_id, im_id)[None]
            K = dataset.intrinsics(scene_id, im_id).float()[None]
            start = time.perf_counter()
            with torch.no_grad():
                found = detector(image.to(device), K.to(device), representations, [(scene_id, im_id)])
            seconds = time.perf_counter() - start
            ids_of_image = {"scene_id": scene_id, "image_id": im_id}
            write_json(
                path, [ids_of_image | entry | {"time": seconds} for entry in detection_entries(found, ids)]
            )
        entries += json.loads(path.read_text())
        if progress is not None:
            progress("detect", done, len(images))
    write_json(folder / "detections.json", entries)
    return folder / "detections.json"


def detection_entries(found: Detections, object_ids: Sequence[int]) -> list[dict[str, Any]]:
    """Detections as entries of the BOP'23 format, but for the image's ids and the time.

    Args:
        found: detections.
        object_ids: ids of the objects, in the order in which the detector had them.
    """
    boxes, _ = boxes_from_masks(found.masks)
    entries = []
    for box, mask, label, score in zip(
        boxes.tolist(), found.masks.cpu(), found.object_index.tolist(), found.score.tolist(), strict=True
    ):
        left, top, right, bottom = box
        entries.append(
            {
                "category_id": object_ids[label],
                "score": score,
                "bbox": [left + 0.5, top + 0.5, right - left, bottom - top],
                "segmentation": encode_segmentation(mask),
            }
        )
    return entries

"""Proposals that are known already."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import torch

from foundpose.bop.files import BopError, read_json
from foundpose.bop.segmentation import decode_segmentation
from foundpose.detection.proposals import Pictures, Proposals, Proposer, pad_proposals
from foundpose.geometry import boxes_from_xywh, masks_from_boxes


class FileProposer(Proposer):
    """Masks or boxes of a JSON file, such as any detector's or segmenter's.

    Args:
        path: a list of entries in BOP's format of detections: ``scene_id``, ``image_id``, ``segmentation`` (COCO's
            run lengths or polygons) or, without one, ``bbox`` ([x, y, width, height]), and ``score`` if there is
            one. ``category_id`` is not read.

    Raises:
        FileNotFoundError: no such file.
        BopError: an entry that lacks a field.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self.path = Path(path)
        self._regions: dict[object, list[tuple[str, dict[str, Any]]]] = defaultdict(list)
        entries = read_json(self.path)
        if not isinstance(entries, list):
            raise BopError(f"{path} must hold a JSON list of regions, it holds {type(entries).__name__}")
        for position, entry in enumerate(entries):
            where = f"{path}: entry {position}"
            try:
                key = (int(entry["scene_id"]), int(entry["image_id"]))
                if "segmentation" not in entry and len([float(x) for x in entry["bbox"]]) != 4:
                    raise ValueError(f"bbox must be [x, y, width, height], got {entry['bbox']}")
            except (KeyError, TypeError, ValueError) as error:
                raise BopError(f"{where} lacks or misspells a field: {error!r}") from error
            self._regions[key].append((where, entry))

    def forward(self, pictures: Pictures) -> Proposals:
        """The regions of pictures, whose names must be (scene_id, image_id).

        Raises:
            ValueError: the pictures have no names.
            BopError: a region that is none, or does not fit its picture.
        """
        if pictures.names is None:
            raise ValueError(
                f"proposals of {self.path} are found by the pictures' names: (scene_id, image_id)"
            )
        height, width = pictures.images.shape[-2:]
        device = pictures.images.device
        masks, scores = [], []
        for name in pictures.names:
            regions = self._regions.get(name, [])
            mask = torch.zeros(len(regions), height, width, dtype=torch.bool)
            for place, (where, entry) in enumerate(regions):
                if "segmentation" in entry:
                    try:
                        mask[place] = decode_segmentation(entry["segmentation"], (height, width))
                    except BopError as error:
                        raise BopError(f"{where}: {error}") from error
                else:
                    box = boxes_from_xywh(torch.tensor([entry["bbox"]], dtype=torch.float32))
                    mask[place] = masks_from_boxes(box, height, width)[0]
            masks.append(mask.to(device))
            scores.append(torch.tensor([float(e.get("score", 1.0)) for _, e in regions], device=device))
        return pad_proposals(masks, scores)

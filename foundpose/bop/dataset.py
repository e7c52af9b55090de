"""Reader of datasets in BOP's scenewise layout."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import torch
from torch import Tensor

from foundpose.bop.files import BopError, describe_folder, read_image, read_json, read_mask


class Target(NamedTuple):
    """Instances of an object to be localised in an image, as listed by ``test_targets_*.json``."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int


@dataclass(frozen=True)
class Annotation:
    """Ground truth of one object instance.

    Attributes:
        obj_id: the object.
        index: position in the image's list of annotations; names the mask files.
        T_camera_from_model: (4, 4) float64 as published: the rotation's scale may differ from 1 by 0.5 %.
        visible_fraction: share of the object's silhouette that is visible, or None where it is not annotated.
    """

    obj_id: int
    index: int
    T_camera_from_model: Tensor
    visible_fraction: float | None


class BopDataset:
    """One split of a BOP dataset. Ground truth is read only when asked for and may be absent.

    Args:
        root: folder of the dataset; holds ``models/`` and the split.
        split: folder of the scenes.
        models: folder of the meshes to onboard.
        targets: file that lists what to localise.

    Raises:
        FileNotFoundError: ``root`` holds no such dataset; the message says what was looked for and what is there.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "test",
        models: str = "models",
        targets: str = "test_targets_bop19.json",
    ) -> None:
        self.root = Path(root).expanduser()
        self.split = self.root / split
        self.models = self.root / models
        self.targets_path = self.root / targets
        if not self.root.is_dir():
            raise FileNotFoundError(
                f"no BOP dataset at {self.root}: no such folder. Set data.root (or BOP_PATH) to a folder that holds "
                f"{models}/ and {split}/"
            )
        for folder in (self.models, self.split):
            if not folder.is_dir():
                raise FileNotFoundError(
                    f"no BOP dataset at {self.root}: {folder.name}/ is missing; {describe_folder(self.root)}"
                )
        self.models_info: dict[int, dict[str, Any]] = {
            int(key): value for key, value in read_json(self.models / "models_info.json").items()
        }

    @property
    def object_ids(self) -> list[int]:
        """Ids of all objects, ascending."""
        return sorted(self.models_info)

    def mesh_path(self, obj_id: int) -> Path:
        """Mesh of an object."""
        path = self.models / f"obj_{obj_id:06d}.ply"
        if obj_id not in self.models_info or not path.is_file():
            raise FileNotFoundError(
                f"object {obj_id} has no mesh at {path}; the dataset has {self.object_ids}"
            )
        return path

    def diameter(self, obj_id: int) -> float:
        """Diameter of an object as published, mesh units."""
        return float(self.models_info[obj_id]["diameter"])

    def targets(self) -> list[Target]:
        """What to localise, in the file's order."""
        entries = read_json(self.targets_path)
        try:
            return [Target(e["scene_id"], e["im_id"], e["obj_id"], e["inst_count"]) for e in entries]
        except (KeyError, TypeError) as error:
            raise BopError(
                f"{self.targets_path}: an entry lacks scene_id, im_id, obj_id or inst_count ({error!r})"
            ) from error

    def intrinsics(self, scene_id: int, im_id: int) -> Tensor:
        """Intrinsics (3, 3) float64 of an image, pixels."""
        cameras = self._scene_json(scene_id, "scene_camera.json")
        return torch.tensor(self._entry(cameras, scene_id, im_id)["cam_K"], dtype=torch.float64).reshape(3, 3)

    def image(self, scene_id: int, im_id: int) -> Tensor:
        """Picture (3, H, W) float32 in [0, 1]; from ``rgb/`` or ``gray/``."""
        return read_image(self.image_path(scene_id, im_id))

    def image_size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        """(height, width) of a picture in pixels, from the file's header."""
        shape = iio.improps(self.image_path(scene_id, im_id)).shape
        return int(shape[0]), int(shape[1])

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """File of a picture."""
        scene = self._scene(scene_id)
        for folder in ("rgb", "gray"):
            for suffix in (".png", ".jpg", ".tif"):
                path = scene / folder / f"{im_id:06d}{suffix}"
                if path.is_file():
                    return path
        raise FileNotFoundError(f"no image {im_id} in {scene} (looked for rgb/ and gray/; png, jpg and tif)")

    def annotations(self, scene_id: int, im_id: int) -> list[Annotation]:
        """Ground truth of an image.

        Raises:
            FileNotFoundError: the split has no ground truth.
        """
        entries = self._entry(self._scene_json(scene_id, "scene_gt.json"), scene_id, im_id)
        infos: list[dict[str, Any]] = [{} for _ in entries]
        if (self._scene(scene_id) / "scene_gt_info.json").is_file():
            infos = self._entry(self._scene_json(scene_id, "scene_gt_info.json"), scene_id, im_id)
        annotations = []
        for index, (entry, info) in enumerate(zip(entries, infos, strict=True)):
            T = torch.eye(4, dtype=torch.float64)
            T[:3, :3] = torch.tensor(entry["cam_R_m2c"], dtype=torch.float64).reshape(3, 3)
            T[:3, 3] = torch.tensor(entry["cam_t_m2c"], dtype=torch.float64)
            annotations.append(Annotation(int(entry["obj_id"]), index, T, info.get("visib_fract")))
        return annotations

    def visible_mask(self, scene_id: int, im_id: int, annotation_index: int) -> Tensor:
        """Ground-truth mask (H, W) bool of the visible part of an instance."""
        path = self._scene(scene_id) / "mask_visib" / f"{im_id:06d}_{annotation_index:06d}.png"
        return read_mask(path, self.image_size(scene_id, im_id), may_be_empty=True)

    def _scene(self, scene_id: int) -> Path:
        scene = self.split / f"{scene_id:06d}"
        if not scene.is_dir():
            raise FileNotFoundError(f"scene {scene_id} is missing; {describe_folder(self.split)}")
        return scene

    def _scene_json(self, scene_id: int, name: str) -> dict[str, Any]:
        content = _cached_json(self._scene(scene_id) / name)
        if not isinstance(content, dict):
            raise BopError(f"{self._scene(scene_id) / name} must map image ids to entries")
        return content

    def _entry(self, content: dict[str, Any], scene_id: int, im_id: int) -> Any:
        if str(im_id) not in content:
            raise BopError(f"scene {scene_id} of {self.root} has no entry for image {im_id}")
        return content[str(im_id)]


@lru_cache(maxsize=64)
def _cached_json(path: Path) -> Any:
    return read_json(path)

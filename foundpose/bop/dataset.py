"""Reader of datasets in BOP's scenewise layout."""

from os.path import isdir, isfile
from pathlib import Path
from typing import Any

from torch import Tensor

from foundpose.bop.files import BopError, JsonCache, parse_models_info
from foundpose.bop.masks import read_mask
from foundpose.bop.scenes import Annotation, parse_annotations, parse_depth_scale, parse_intrinsics
from foundpose.bop.targets import Target, count_visible, describe_target, parse_targets
from foundpose.bop.vsd import BOP_DELTA
from foundpose.geometry.symmetries import symmetries_from_models_info
from foundpose.utils.files import describe_folder
from foundpose.utils.pictures import read_depth, read_image, read_image_size


class BopDataset:
    """One split of a BOP dataset.

    Files are read when they are asked for. Ground truth and the models for evaluation may be absent; what inference
    needs never looks at them. A dataset can be pickled; JSON files that it has read do not travel along.

    Args:
        root: folder of the dataset; holds ``models/`` and the split.
        split: folder of the scenes.
        models: folder of the meshes to onboard.
        targets: file that lists what to find, in the format of bop19 (objects of images, with the number of their
            instances) or bop24 (images).
        models_eval: folder of the meshes that errors are measured with.
        vsd_delta: visibility tolerance of VSD, millimetres; the benchmark takes 5 for ITODD and 15 for all others.

    Raises:
        FileNotFoundError: ``root`` holds no such dataset; the message says what was looked for and what is there.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "test",
        models: str = "models",
        targets: str = "test_targets_bop19.json",
        models_eval: str = "models_eval",
        vsd_delta: float = BOP_DELTA,
    ) -> None:
        if not vsd_delta > 0:
            raise ValueError(f"vsd_delta must be positive (millimetres), got {vsd_delta}")
        self.root = Path(root).expanduser()
        self.split = self.root / split
        self.models = self.root / models
        self.models_eval = self.root / models_eval
        self.vsd_delta = vsd_delta
        self.targets_path = self.root / targets
        _check_layout(self.root, models, split)
        self._cache = JsonCache()
        self.models_info = self._read_models_info(self.models)

    @property
    def name(self) -> str:
        """Name of the dataset's folder, such as ``lmo``."""
        return self.root.resolve().name

    @property
    def object_ids(self) -> list[int]:
        """Ids of all objects, ascending."""
        return sorted(self.models_info)

    def object_name(self, obj_id: int) -> str:
        """Name of an object's representation, such as ``lmo-000005``."""
        return f"{self.name}-{obj_id:06d}"

    def mesh_path(self, obj_id: int) -> Path:
        """Mesh of an object, for onboarding."""
        return _mesh_path(self.models, self.models_info, obj_id)

    def diameter(self, obj_id: int) -> float:
        """Diameter of an object as published, mesh units."""
        return _diameter(self.models, self.models_info, obj_id)

    def has_evaluation_models(self) -> bool:
        """Whether there are meshes to measure errors with."""
        return (self.models_eval / "models_info.json").is_file()

    def evaluation_mesh_path(self, obj_id: int) -> Path:
        """Mesh of an object, for errors.

        Raises:
            FileNotFoundError: there is none.
        """
        return _mesh_path(self.models_eval, self._read_models_info(self.models_eval), obj_id)

    def evaluation_info(self, obj_id: int) -> dict[str, Any]:
        """An object's entry of ``models_info.json`` beside the meshes for errors: diameter, symmetries.

        Raises:
            FileNotFoundError: there is no such file or entry.
            BopError: the diameter is no positive number, or a symmetry is none.
        """
        infos = self._read_models_info(self.models_eval)
        _diameter(self.models_eval, infos, obj_id)
        try:
            symmetries_from_models_info(infos[obj_id])
        except ValueError as error:
            raise BopError(f"{self.models_eval / 'models_info.json'}, object {obj_id}: {error}") from error
        return infos[obj_id]

    def targets(self) -> list[Target]:
        """What to find, in the file's order.

        Raises:
            FileNotFoundError: no such file, or one that names a scene that does not exist.
            BopError: not a list of targets, a target twice, or one that names an image or object that does not exist.
        """
        targets = parse_targets(self._cache.read(self.targets_path), self.targets_path)
        for target in targets:
            name = f"{self.targets_path} lists {describe_target(*target[:3])}"
            if not (self.split / f"{target.scene_id:06d}").is_dir():
                raise FileNotFoundError(f"{name}, which does not exist; {describe_folder(self.split)}")
            if str(target.im_id) not in self._scene_json(target.scene_id, "scene_camera.json"):
                raise BopError(f"{name}, which scene_camera.json does not have")
            if target.obj_id is not None and target.obj_id not in self.models_info:
                raise BopError(f"{name}; the dataset has the objects {self.object_ids}")
        return targets

    def images(self) -> list[tuple[int, int]]:
        """(scene, image) of the targets, ascending, each once."""
        return sorted({(target.scene_id, target.im_id) for target in self.targets()})

    def localization_targets(self, targets: list[Target] | None = None) -> list[Target]:
        """Objects to localise with the number of their instances.

        Targets of bop19 are so already. Those of bop24 name images; from the ground truth of these follow the
        objects, with as many instances as are visible by at least a tenth.

        Args:
            targets: all of the dataset's by default.

        Raises:
            FileNotFoundError: bop24 targets without ground truth.
            BopError: bop24 targets with ground truth that does not say what is visible.
        """
        result = []
        for target in self.targets() if targets is None else targets:
            if target.obj_id is not None:
                result.append(target)
                continue
            annotations = self.annotations(target.scene_id, target.im_id)
            result += count_visible(
                target.scene_id, target.im_id, [(a.obj_id, a.visible_fraction) for a in annotations]
            )
        return result

    def intrinsics(self, scene_id: int, im_id: int) -> Tensor:
        """Intrinsics (3, 3) float64 of an image, pixels."""
        return parse_intrinsics(*self._entry(scene_id, im_id, "scene_camera.json"))

    def image(self, scene_id: int, im_id: int) -> Tensor:
        """Picture (3, H, W) float32 in [0, 1]; from ``rgb/`` or ``gray/``."""
        return read_image(self.image_path(scene_id, im_id))

    def image_size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        """(height, width) of a picture in pixels, from the file's header."""
        return read_image_size(self.image_path(scene_id, im_id))

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """File of a picture."""
        path = self._find_image(scene_id, im_id, ("rgb", "gray"), (".png", ".jpg", ".tif"))
        if path is None:
            scene = self._scene(scene_id)
            raise FileNotFoundError(
                f"no image {im_id} in {scene} (looked for rgb/ and gray/; png, jpg and tif); "
                f"{describe_folder(scene)}"
            )
        return path

    def has_depth(self, scene_id: int, im_id: int) -> bool:
        """Whether an image has a depth image."""
        return self._find_image(scene_id, im_id, ("depth",), (".png", ".tif")) is not None

    def depth(self, scene_id: int, im_id: int) -> Tensor:
        """Depth image (H, W) float32: z of the surface in millimetres, 0 where nothing was measured.

        Raises:
            FileNotFoundError: the image has none.
            PictureError: not a depth image, or one of another size than its image.
            BopError: there is no ``depth_scale``.
        """
        path = self._find_image(scene_id, im_id, ("depth",), (".png", ".tif"))
        if path is None:
            scene = self._scene(scene_id)
            raise FileNotFoundError(
                f"no depth image {im_id} in {scene} (looked for depth/; png and tif); {describe_folder(scene)}"
            )
        scale = parse_depth_scale(*self._entry(scene_id, im_id, "scene_camera.json"))
        return read_depth(path, scale, self.image_size(scene_id, im_id))

    def has_ground_truth(self, scene_id: int) -> bool:
        """Whether a scene has annotations."""
        return (self._scene(scene_id) / "scene_gt.json").is_file()

    def annotations(self, scene_id: int, im_id: int) -> list[Annotation]:
        """Ground truth of an image.

        Raises:
            FileNotFoundError: the scene has no ground truth.
            BopError: annotations that cannot be right.
        """
        entries, where = self._entry(scene_id, im_id, "scene_gt.json")
        infos = None
        if (self._scene(scene_id) / "scene_gt_info.json").is_file():
            infos, _ = self._entry(scene_id, im_id, "scene_gt_info.json")
        return parse_annotations(entries, infos, where)

    def mask(self, scene_id: int, im_id: int, annotation_index: int) -> Tensor:
        """Ground-truth mask (H, W) bool of the whole silhouette of an instance, hidden parts included."""
        return self._read_mask("mask", scene_id, im_id, annotation_index)

    def visible_mask(self, scene_id: int, im_id: int, annotation_index: int) -> Tensor:
        """Ground-truth mask (H, W) bool of the visible part of an instance."""
        return self._read_mask("mask_visib", scene_id, im_id, annotation_index)

    def _read_mask(self, folder: str, scene_id: int, im_id: int, annotation_index: int) -> Tensor:
        path = self._scene(scene_id) / folder / f"{im_id:06d}_{annotation_index:06d}.png"
        return read_mask(path, self.image_size(scene_id, im_id), checked=False)

    def _scene(self, scene_id: int) -> Path:
        scene = self.split / f"{scene_id:06d}"
        if not scene.is_dir():
            raise FileNotFoundError(f"scene {scene_id} is missing; {describe_folder(self.split)}")
        return scene

    def _find_image(
        self, scene_id: int, im_id: int, folders: tuple[str, ...], suffixes: tuple[str, ...]
    ) -> Path | None:
        scene = self._scene(scene_id)
        paths = (scene / folder / f"{im_id:06d}{suffix}" for folder in folders for suffix in suffixes)
        return next((path for path in paths if path.is_file()), None)

    def _scene_json(self, scene_id: int, name: str) -> dict[str, Any]:
        path = self._scene(scene_id) / name
        content = self._cache.read(path)
        if not isinstance(content, dict):
            raise BopError(f"{path} must map image ids to entries")
        return content

    def _entry(self, scene_id: int, im_id: int, name: str) -> tuple[Any, str]:
        """An image's entry of a scene's file, and the words to name it."""
        content = self._scene_json(scene_id, name)
        path = self._scene(scene_id) / name
        if str(im_id) not in content:
            raise BopError(f"{path} has no entry for image {im_id}")
        return content[str(im_id)], f"{path}, image {im_id}"

    def _read_models_info(self, folder: Path) -> dict[int, dict[str, Any]]:
        path = folder / "models_info.json"
        return parse_models_info(self._cache.read(path), path)


def _mesh_path(folder: Path, infos: dict[int, dict[str, Any]], obj_id: int) -> Path:
    path = folder / f"obj_{obj_id:06d}.ply"
    if obj_id not in infos or not path.is_file():
        raise FileNotFoundError(f"object {obj_id} has no mesh at {path}; the dataset has {sorted(infos)}")
    return path


def _diameter(folder: Path, infos: dict[int, dict[str, Any]], obj_id: int) -> float:
    path = folder / "models_info.json"
    if obj_id not in infos:
        raise FileNotFoundError(f"{path} has no object {obj_id}; it has {sorted(infos)}")
    diameter = infos[obj_id].get("diameter")
    if not isinstance(diameter, int | float) or not 0 < diameter < float("inf"):
        raise BopError(f"{path}: the diameter of object {obj_id} must be a positive number, got {diameter!r}")
    return float(diameter)


def _check_layout(root: Path, models: str, split: str) -> None:
    """Raise FileNotFoundError unless ``root`` holds the folders; say where they may be."""
    if not root.is_dir():
        raise FileNotFoundError(
            f"no BOP dataset at {root}: no such folder. Set data.root (or BOP_PATH) to a folder that holds "
            f"{models}/ and {split}/{_hint(root, models, split)}"
        )
    for name in (models, split):
        if not (root / name).is_dir():
            raise FileNotFoundError(
                f"no BOP dataset at {root}: {name}/ is missing; {describe_folder(root)}{_hint(root, models, split)}"
            )


def _hint(root: Path, models: str, split: str) -> str:
    """Where a dataset is that ``root`` may have meant: above it, or below it."""

    def is_dataset(folder: Path) -> bool:
        # These are False, too, for folders that may not be read.
        return isfile(folder / models / "models_info.json") and isdir(folder / split)

    root = root.resolve()
    near = [folder for folder in root.parents[:2] if is_dataset(folder)]
    if root.is_dir():
        near += [folder for folder in sorted(root.iterdir()) if is_dataset(folder)]
        if not near and (root / models).is_dir():
            splits = [f.name for f in sorted(root.iterdir()) if any(f.glob("[0-9]*/scene_camera.json"))]
            return f". Folders with scenes: {', '.join(splits)} (data.split)" if splits else ""
    names = " or ".join(str(folder) for folder in near[:8])
    return f". There is one at {names}: is that the root?" if near else ""

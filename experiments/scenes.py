"""Pictures with a known pose, for the demo: a photograph from files, one of a BOP dataset, or a procedural one."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.bop import BopDataset, read_image, read_mask
from foundpose.geometry import intrinsics_matrix, make_transform, project_to_rotation
from foundpose.rendering import Mesh, load_mesh
from foundpose.synthetic import cluttered_scene, procedural_mesh

_CHECKOUT = Path(__file__).resolve().parents[1]
# Published rotations are scaled by up to half a percent.
_ROTATION_TOLERANCE = 0.02


class KnownScene(NamedTuple):
    """An object in a picture, and the truth about it.

    Attributes:
        name: of the object.
        mesh: the object.
        image: (3, H, W) in [0, 1].
        K: (3, 3) intrinsics, pixels.
        mask: (H, W) bool, visible part of the object.
        T_camera_from_model: (4, 4) true pose, mesh units.
    """

    name: str
    mesh: Mesh
    image: Tensor
    K: Tensor
    mask: Tensor
    T_camera_from_model: Tensor


def photograph(
    name: str,
    image: str | Path,
    mask: str | Path,
    mesh: str | Path,
    intrinsics: Sequence[float],
    rotation: Sequence[float],
    translation: Sequence[float],
) -> KnownScene:
    """A photograph from files, which lie relative to the working directory or else to the checkout's root.

    Args:
        name: what to call the object.
        image: the photograph.
        mask: picture of the same size, bright where the object is visible.
        mesh: the object.
        intrinsics: fx, fy, cx, cy in pixels; integer coordinates are pixel centres.
        rotation: nine numbers of the true ``R_camera_from_model``, row by row.
        translation: three numbers of the true pose, mesh units.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file cannot be read, the mask has another size, or numbers that are no camera or no pose.
    """
    fx, fy, cx, cy = _numbers("intrinsics", intrinsics, 4)
    if min(fx, fy) <= 0:
        raise ValueError(f"focal lengths must be positive, got fx={fx}, fy={fy}")
    R = torch.tensor(_numbers("rotation", rotation, 9), dtype=torch.float64).reshape(3, 3)
    straight = project_to_rotation(R)
    if float((R - straight).abs().max()) > _ROTATION_TOLERANCE:
        raise ValueError(
            f"rotation must be that of a rotation matrix, row by row, got {R.flatten().tolist()}"
        )
    t = torch.tensor(_numbers("translation", translation, 3), dtype=torch.float64)
    picture = read_image(_find(image))
    height, width = picture.shape[1:]
    return KnownScene(
        name,
        load_mesh(_find(mesh)),
        picture,
        intrinsics_matrix(fx, fy, cx, cy),
        read_mask(_find(mask), (height, width)),
        make_transform(straight, t).float(),
    )


def bop_picture(dataset: BopDataset, scene_id: int, im_id: int, obj_id: int) -> KnownScene:
    """A picture of a BOP dataset with ground truth; of several instances of the object the most visible one.

    Args:
        dataset: where it lies.
        scene_id: the scene.
        im_id: the image.
        obj_id: the object.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: the object is not in the picture, or not visible.
    """
    found = [a for a in dataset.annotations(scene_id, im_id) if a.obj_id == obj_id]
    if not found:
        raise ValueError(f"object {obj_id} is not in image {im_id} of scene {scene_id}")
    truth = max(found, key=lambda a: a.visible_fraction if a.visible_fraction is not None else 1.0)
    mask = dataset.visible_mask(scene_id, im_id, truth.index)
    if not bool(mask.any()):
        raise ValueError(f"object {obj_id} is hidden in image {im_id} of scene {scene_id}")
    T = truth.T_camera_from_model
    return KnownScene(
        dataset.object_name(obj_id),
        load_mesh(dataset.mesh_path(obj_id)),
        dataset.image(scene_id, im_id),
        dataset.intrinsics(scene_id, im_id).float(),
        mask,
        make_transform(project_to_rotation(T[:3, :3]), T[:3, 3]).float(),
    )


def procedural(seed: int) -> KnownScene:
    """A procedural object in a cluttered picture, both different for every seed."""
    mesh = procedural_mesh(seed)
    scene = cluttered_scene(mesh, seed)
    return KnownScene(f"demo-{seed}", mesh, scene.image, scene.K, scene.mask, scene.T_camera_from_model)


def _find(path: str | Path) -> Path:
    """A file as given, or where it lies in the checkout; as given too where there is none, for the message."""
    path, here = Path(path), _CHECKOUT / path
    return here if here.is_file() and not path.is_file() else path


def _numbers(name: str, values: Sequence[float], count: int) -> list[float]:
    """So many numbers of the config."""
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != count:
        raise ValueError(f"{name} must be {count} numbers, got {values}")
    if not all(isinstance(v, int | float) for v in values):
        raise ValueError(f"{name} must be {count} numbers, got {list(values)}")
    return [float(v) for v in values]

"""Why an estimate is wrong: errors against the ground truth, and the first cause that explains them."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from foundpose.bop import BopDataset, Instance
from foundpose.bop.errors import ModelErrors
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import pose_of
from foundpose.geometry import (
    axis_rotation_to_ray,
    intrinsics_matrix,
    project_to_rotation,
    resize_intrinsics,
    rotation_angle,
)
from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.rendering.mesh_files import read_mesh_file

RIGHT_DIAMETERS, RIGHT_PIXELS = (
    0.1,
    10.0,
)  # MSSD or MSPD (of a picture 640 px wide) below which a pose is right
_MASK_OVERLAP = 0.5
_TURNED = 20.0  # degrees; below, a pose is the right one, badly placed
_TEMPLATE = 35.0  # degrees; the nearest of 800 templates lies within about 20
_BEHIND = 140.0  # degrees between the directions from which the object is seen
_ALIKE = 0.85  # overlap of outlines that can hardly be told apart
_FEW_INLIERS = 0.15  # of the patches
_OUTLINE = 160  # pixels


class Judgement(NamedTuple):
    """An estimate beside the truth; errors are None where there is no pose, or nothing to compare it with.

    Attributes:
        reason: ``right``, or what explains the error: ``not in the picture``, ``mask``, ``no pose``, ``misplaced``
            (turned rightly), ``symmetric`` (the outlines are nearly the same), ``mirrored`` (seen from behind), ``few
            inliers``, ``wrong template`` (none that was retrieved is near) or ``wrong choice`` (one is).
        T_true: (4, 4) float64 of the annotation that the mask is nearest to.
        mssd: diameters.
        mspd: pixels of a picture 640 px wide.
        rotation: degrees to the nearest of the symmetric truths.
        translation: mesh units.
        overlap: intersection over union of the mask and the visible part of the annotation.
    """

    reason: str
    T_true: Tensor | None = None
    mssd: float | None = None
    mspd: float | None = None
    rotation: float | None = None
    translation: float | None = None
    overlap: float | None = None


def judge(
    dataset: BopDataset,
    objects: DatasetObjects,
    records: Sequence[Mapping[str, Any]],
    instances: Sequence[Instance] | None = None,
) -> list[Judgement]:
    """Compare estimates with the ground truth.

    Args:
        dataset: with ground truth and models for evaluation.
        objects: the dataset's objects.
        records: estimates, as :func:`foundpose.evaluation.records.pose_records` with ids; ``templates`` may lack.
        instances: the masks that they were made from, one for each; None where they are not known.

    Returns:
        One for each record.
    """
    judged: list[Judgement] = [Judgement("not in the picture")] * len(records)
    by_object: dict[int, list[int]] = defaultdict(list)
    for place, record in enumerate(records):
        by_object[record["obj_id"]].append(place)
    for obj_id, places in by_object.items():
        one = _OneObject(dataset, objects, obj_id)
        for place in places:
            judged[place] = one(records[place], None if instances is None else instances[place])
    return judged


class _OneObject:
    """Judges the estimates of one object."""

    def __init__(self, dataset: BopDataset, objects: DatasetObjects, obj_id: int) -> None:
        self.dataset, self.objects, self.obj_id = dataset, objects, obj_id
        vertices = torch.from_numpy(read_mesh_file(dataset.evaluation_mesh_path(obj_id)).vertices)
        self.errors = ModelErrors.from_models_info(vertices, dataset.evaluation_info(obj_id))
        self.R_symmetric = self.errors.symmetries[:, :3, :3]

    def __call__(self, record: Mapping[str, Any], instance: Instance | None) -> Judgement:
        image = (record["scene_id"], record["im_id"])
        T_est = pose_of(record) if record["valid"] else None
        T_true, overlap = self._truth(image, T_est, instance)
        if T_true is None:
            return Judgement("not in the picture")
        if T_est is None:
            empty = record["status"] in ("UNUSABLE_MASK", "NO_PATCHES")
            wrong_mask = empty or (overlap is not None and overlap < _MASK_OVERLAP)
            return Judgement("mask" if wrong_mask else "no pose", T_true, overlap=overlap)
        K = self.dataset.intrinsics(*image).double()
        mssd, mspd = (float(e) for e in self.errors(T_est[None], T_true[None], K[None]))
        R_true = project_to_rotation(T_true[:3, :3]) @ self.R_symmetric
        judgement = Judgement(
            "right",
            T_true,
            mssd / self.errors.diameter,
            mspd * 640.0 / self.dataset.image_size(*image)[1],
            _degrees(T_est[:3, :3], R_true),
            float((T_est[:3, 3] - T_true[:3, 3]).norm()),
            overlap,
        )
        return judgement._replace(reason=self._reason(judgement, record, T_est, R_true))

    def _truth(
        self, image: tuple[int, int], T_est: Tensor | None, instance: Instance | None
    ) -> tuple[Tensor | None, float | None]:
        """The annotation that a mask is of, and how far they agree; without a mask the one nearest to the pose."""
        found = [a for a in self.dataset.annotations(*image) if a.obj_id == self.obj_id]
        if not found:
            return None, None
        if instance is not None:
            mask = instance.mask(self.dataset)
            overlaps = [_overlap(mask, self.dataset.visible_mask(*image, a.index)) for a in found]
            best = max(range(len(found)), key=lambda k: overlaps[k])
            if overlaps[best] > 0:
                return found[best].T_camera_from_model, overlaps[best]
        true = torch.stack([a.T_camera_from_model for a in found])
        offset = true[:, :3, 3] - (torch.zeros(3) if T_est is None else T_est[:3, 3])
        return true[int(offset.norm(dim=1).argmin())], None if instance is None else 0.0

    def _reason(self, j: Judgement, record: Mapping[str, Any], T_est: Tensor, R_true: Tensor) -> str:
        assert j.T_true is not None
        assert j.mssd is not None
        assert j.mspd is not None
        assert j.rotation is not None
        if j.mssd < RIGHT_DIAMETERS or j.mspd < RIGHT_PIXELS:
            return "right"
        if j.overlap is not None and j.overlap < _MASK_OVERLAP:
            return "mask"
        if j.rotation < _TURNED:
            return "misplaced"
        if _same_outline(self.objects.mesh(self.obj_id), T_est, j.T_true):
            return "symmetric"
        seen_from = -R_true.mT @ j.T_true[:3, 3] / j.T_true[:3, 3].norm()
        cosine = float((seen_from @ (-T_est[:3, :3].T @ T_est[:3, 3] / T_est[:3, 3].norm())).max())
        if cosine < math.cos(math.radians(_BEHIND)):
            return "mirrored"
        if "num_inliers" in record and 0 < record["num_inliers"] < _FEW_INLIERS * record["num_patches"]:
            return "few inliers"
        if "templates" not in record:
            return "wrong template"
        representation = self.objects.representations([self.obj_id])[0]
        views = representation.T_template_from_model[record["templates"], :3, :3].double().cpu()
        R_crop = axis_rotation_to_ray(j.T_true[None, :3, 3])[0] @ R_true
        nearest = min(_degrees(view, R_crop) for view in views)
        return "wrong template" if nearest > _TEMPLATE else "wrong choice"


def _degrees(R: Tensor, R_true: Tensor) -> float:
    """Angle of a rotation (3, 3) to the nearest of (S, 3, 3)."""
    return float(torch.rad2deg(rotation_angle(R.expand_as(R_true), R_true)).min())


def _overlap(a: Tensor, b: Tensor) -> float:
    return float((a & b).sum() / (a | b).sum().clamp(min=1))


def _same_outline(mesh: Mesh, T_est: Tensor, T_true: Tensor) -> bool:
    """Whether an object's outlines under two poses can hardly be told apart."""
    # A camera that looks at the object, wherever it is in the picture.
    R = axis_rotation_to_ray(T_true[None, :3, 3])[0]
    focal = 0.7 * float(T_true[:3, 3].norm()) / mesh.diameter
    K = resize_intrinsics(intrinsics_matrix(focal, focal, 0.0, 0.0).double(), _OUTLINE)
    T = torch.stack([T_est, T_true])
    T = torch.cat([R @ T[:, :3], T[:, 3:]], dim=1)
    masks = RaycastRenderer(supersampling=1)(mesh, T, K[None], (_OUTLINE, _OUTLINE)).mask
    return _overlap(masks[0], masks[1]) > _ALIKE

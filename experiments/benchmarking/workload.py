"""A synthetic object, pictures of it and descriptors, of any size: what the benchmark runs on.

The object is an ellipsoid, whose points, masks and templates have closed forms, so a workload of the paper's size
takes seconds to make and nothing to download. A patch's descriptor is a smooth code of the point that it sees, so
retrieval, matching, RANSAC and refinement have as much to do as with good features; a share of the crops' patches is
replaced by noise, which decides how long RANSAC samples.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from benchmarking.scripted import ScriptedExtractor
from benchmarking.sizes import PATCH, WorkloadSizes
from foundpose.features import CoordinateCode, PcaProjection
from foundpose.features.base import Fingerprint
from foundpose.geometry import (
    PerspectiveCrop,
    camera_on_boxes,
    intrinsics_matrix,
    make_transform,
    pixel_grid,
    pixel_rays,
    super_fibonacci_rotations,
)
from foundpose.onboarding.onboarder import describe_by_words
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from foundpose.retrieval import SoftAssignBow
from foundpose.utils.settings import identity

SEMI_AXES = (50.0, 45.0, 40.0)
"""Of the object, in mm."""
_DISTANCE = 6.0  # of the templates' cameras, in diameters


class Workload(NamedTuple):
    """What the pipeline is given.

    Attributes:
        sizes: how large everything is.
        representation: the onboarded object.
        images: (N, 3, H, W) in [0, 1], noise.
        K: (N, 3, 3) intrinsics.
        masks: (B, H, W) bool.
        image_index: (B,) the picture of each mask.
        T_camera_from_model: (B, 4, 4) true poses.
        features: raw descriptors (B, C, g, g) of the crops that ``PerspectiveCrop(size, fill)`` cuts.
    """

    sizes: WorkloadSizes
    representation: ObjectRepresentation
    images: Tensor
    K: Tensor
    masks: Tensor
    image_index: Tensor
    T_camera_from_model: Tensor
    features: Tensor

    def to(self, dtype: torch.dtype) -> "Workload":
        """The workload in another floating-point type; the representation is converted in place."""
        return self._replace(
            representation=self.representation.to(dtype=dtype),
            images=self.images.to(dtype),
            K=self.K.to(dtype),
            T_camera_from_model=self.T_camera_from_model.to(dtype),
            features=self.features.to(dtype),
        )


def make_workload(
    sizes: WorkloadSizes, device: torch.device | str = "cpu", extractor: Fingerprint | None = None
) -> Workload:
    """Build a workload; the same for the same sizes, up to rounding, on every device.

    Args:
        sizes: how large.
        device: where the tensors go.
        extractor: fingerprint of the extractor that the representation is to pass for; None for
            :class:`ScriptedExtractor`'s.
    """
    code = CoordinateCode(sizes.components, seed=sizes.seed).to(device)
    projection = _isometry(sizes).to(device)
    representation = _representation(sizes, code, projection, extractor or ScriptedExtractor.identity(sizes))
    return _pictures(sizes, code, representation)


def with_crops(workload: Workload, batch_size: int, images: int = 1) -> Workload:
    """The same object, with another number of crops cut from another number of pictures."""
    sizes = replace(workload.sizes, batch_size=batch_size, images=images)
    code = CoordinateCode(sizes.components, seed=sizes.seed).to(workload.features.device)
    return _pictures(sizes, code, workload.representation).to(workload.features.dtype)


def ellipsoid_mesh(subdivisions: int = 4) -> Mesh:
    """The object as a mesh, for refiners that render."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = torch.from_numpy(np.array(sphere.vertices)) * torch.tensor(SEMI_AXES)
    return Mesh(vertices.float(), torch.from_numpy(np.array(sphere.faces, dtype=np.int64)))


def subset(representation: ObjectRepresentation, templates: int) -> ObjectRepresentation:
    """The object with its first templates only (they are not evenly spread)."""
    last = int(representation.template_offsets[templates])
    return ObjectRepresentation(
        representation.projection,
        representation.words,
        representation.idf,
        representation.template_bow[:templates],
        representation.descriptors[:last],
        representation.points_model[:last],
        representation.patch_index[:last],
        representation.template_offsets[: templates + 1],
        representation.T_template_from_model[:templates],
        representation.K_template[:templates],
        None,
        representation.info,
        representation.codec,
    )


def _isometry(sizes: WorkloadSizes) -> PcaProjection:
    """A projection with orthonormal components, so that descriptors can be made from their coordinates."""
    generator = torch.Generator().manual_seed(sizes.seed)
    square = torch.randn(sizes.channels, sizes.components, generator=generator, dtype=torch.float64)
    components = torch.linalg.qr(square).Q.T.float().contiguous()
    projection = PcaProjection(sizes.components)
    projection.load_state_dict(
        {
            "mean": torch.randn(sizes.channels, generator=generator),
            "components": components,
            "explained_variance": torch.ones(sizes.components),
        }
    )
    return projection


def _see(T: Tensor, K: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, N, 3) of the ellipsoid that pixels (N, 2) of cameras see, and which see it (B, N)."""
    rays = pixel_rays(pixels.expand(len(T), -1, -1), K)
    axes = T.new_tensor(SEMI_AXES)
    R, t = T[:, :3, :3], T[:, :3, 3:]
    direction = (rays @ R) / axes
    eye = -(t.transpose(1, 2) @ R) / axes
    a, b = direction.square().sum(-1), (direction * eye).sum(-1)
    discriminant = b * b - a * (eye.square().sum(-1) - 1.0)
    hit = discriminant > 0
    near = (-b - discriminant.clamp(min=0.0).sqrt()) / a
    return torch.where(hit.unsqueeze(-1), (eye + near.unsqueeze(-1) * direction) * axes, 0.0), hit


def _encode(code: CoordinateCode, points_model: Tensor) -> Tensor:
    """Descriptors (..., d) of points on the object."""
    angles = (points_model / (2.0 * max(SEMI_AXES))) @ code.directions + code.phases
    return torch.cos(angles) * (code.norm * math.sqrt(2.0 / code.channels))


def _patch_centres(sizes: WorkloadSizes, device: torch.device) -> Tensor:
    """(g², 2) in raster order."""
    cells = pixel_grid(sizes.grid, sizes.grid, device, torch.float32).reshape(-1, 2)
    return cells * PATCH + (PATCH - 1) / 2


def _boxes(T: Tensor, K: Tensor) -> Tensor:
    """Boxes (B, 4) around the projected ellipsoids, from their dual conics."""
    axes = T.new_tensor([*SEMI_AXES, -1.0])
    P = K @ T[:, :3]
    dual = P @ torch.diag(axes.sign() * axes.square()) @ P.transpose(1, 2)
    centre = dual[:, :2, 2] / dual[:, 2:, 2]
    extent = (centre.square() - dual.diagonal(dim1=1, dim2=2)[:, :2] / dual[:, 2:, 2]).sqrt()
    return torch.cat([centre - extent, centre + extent], dim=1)


def _representation(
    sizes: WorkloadSizes, code: CoordinateCode, projection: PcaProjection, extractor: Fingerprint
) -> ObjectRepresentation:
    device = code.directions.device
    rotations = super_fibonacci_rotations(sizes.templates).to(device, torch.float32)
    diameter = 2.0 * max(SEMI_AXES)
    T = make_transform(
        rotations, rotations.new_tensor([0.0, 0.0, _DISTANCE * diameter]).expand(len(rotations), 3)
    )
    K = torch.eye(3, device=device).expand(len(T), 3, 3)
    K, T_turn = camera_on_boxes(_boxes(T, K), K, sizes.crop_size, sizes.fill)
    T = T_turn @ T
    points_model, hit = _see(T, K, _patch_centres(sizes, device))
    counts = hit.sum(1)
    descriptors = _encode(code, points_model[hit])
    generator = torch.Generator().manual_seed(sizes.seed)
    chosen = torch.randperm(len(descriptors), generator=generator)[: sizes.words].to(device)
    bow = SoftAssignBow()
    representation = ObjectRepresentation(
        projection=projection,
        words=descriptors[chosen],
        idf=descriptors.new_zeros(sizes.words),
        template_bow=descriptors.new_zeros(len(T), sizes.words),
        descriptors=descriptors,
        points_model=points_model[hit],
        patch_index=torch.nonzero(hit)[:, 1].to(torch.int16),
        template_offsets=torch.cat([counts.new_zeros(1), counts.cumsum(0)]),
        T_template_from_model=T,
        K_template=K,
        template_cls=None,
        info=RepresentationInfo(
            name="ellipsoid",
            diameter=diameter,
            mesh_checksum="",
            extractor=extractor,
            image_size=sizes.crop_size,
            stride=PATCH,
            offset=(PATCH - 1) / 2,
            grid=sizes.grid,
            settings={"fill": sizes.fill, "bow": identity(bow)},
        ),
    ).to(device)
    with torch.no_grad():
        idf, template_bow = describe_by_words(representation, bow, "document")
    representation.idf.copy_(idf)
    representation.template_bow.copy_(template_bow)
    return representation


def _noisy_regions(sizes: WorkloadSizes, generator: torch.Generator) -> Tensor:
    """Which patches (B, g²) are noise: patches of a few cells, as occluders and background leave them."""
    coarse = torch.randn(sizes.batch_size, 1, 6, 6, generator=generator)
    field = F.interpolate(coarse, size=(sizes.grid, sizes.grid), mode="bilinear").flatten(1)
    return field < field.quantile(sizes.outliers, dim=1, keepdim=True)


def _pictures(sizes: WorkloadSizes, code: CoordinateCode, representation: ObjectRepresentation) -> Workload:
    device = code.directions.device
    height, width = sizes.image_size
    B = sizes.batch_size
    generator = torch.Generator().manual_seed(sizes.seed + 1)
    rotations = F.normalize(torch.randn(B, 4, generator=generator), dim=1)
    w, x, y, z = rotations.unbind(1)
    R = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=1,
    ).reshape(B, 3, 3)
    # About as large in the picture as a household object: a fifth of its height.
    focal = 1.2 * height
    depth = focal * 2.0 * max(SEMI_AXES) / (0.2 * height) * (0.8 + 0.4 * torch.rand(B, generator=generator))
    place = (torch.rand(B, 2, generator=generator) - 0.5) * 0.6
    reach = torch.tensor([width / focal, height / focal])
    t = torch.cat([place * reach, torch.ones(B, 1)], dim=1) * depth[:, None]
    T = make_transform(R, t).to(device)
    K_image = intrinsics_matrix(focal, focal, (width - 1) / 2, (height - 1) / 2).to(device, torch.float32)
    K = K_image.expand(sizes.images, 3, 3).contiguous()
    image_index = (torch.arange(B) * sizes.images // B).to(device)
    _, masks = _see(T, K[image_index], pixel_grid(height, width, device, torch.float32).reshape(-1, 2))
    masks = masks.reshape(B, height, width)
    images = torch.rand(sizes.images, 3, height, width, generator=generator).to(device)

    crops = PerspectiveCrop(sizes.crop_size, sizes.fill)(images, K, masks, image_index=image_index)
    points_model, hit = _see(crops.T_crop_from_camera @ T, crops.K_crop, _patch_centres(sizes, device))
    noise = torch.randn(B, sizes.grid**2, sizes.components, generator=generator).to(device)
    keep = hit & ~_noisy_regions(sizes, generator).to(device)
    codes = torch.where(
        keep.unsqueeze(-1), _encode(code, points_model), noise * (code.norm / math.sqrt(sizes.components))
    )
    projection = representation.projection
    raw = codes @ projection.components.float() + projection.mean.float()
    features = raw.transpose(1, 2).unflatten(2, (sizes.grid, sizes.grid)).contiguous()
    return Workload(sizes, representation, images, K, masks, image_index, T, features)

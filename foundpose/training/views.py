"""Pictures to train on: crops of rendered scenes, and templates near them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from foundpose.geometry import Crops, PerspectiveCrop
from foundpose.onboarding import Onboarder, register_patches, template_cameras
from foundpose.onboarding.templates import RegisteredPatches
from foundpose.rendering import Mesh, Renderer
from foundpose.synthetic import LightVariation, cluttered_scene


class TrueCrops(NamedTuple):
    """Crops with known truth.

    Attributes:
        crops: B perspective crops.
        T_crop_from_model: (B, 4, 4) true poses in the crop cameras, mesh units.
    """

    crops: Crops
    T_crop_from_model: Tensor


class TemplateViews(NamedTuple):
    """Templates as onboarding renders them.

    Attributes:
        rgb: (B, 3, S, S) in [0, 1].
        patches: the points that their patches show.
    """

    rgb: Tensor
    patches: RegisteredPatches


def render_crops(
    mesh: Mesh,
    seeds: Sequence[int],
    crop: PerspectiveCrop,
    renderer: Renderer,
    light: LightVariation | None = None,
    occlusion: bool = True,
    size: tuple[int, int] = (480, 640),
) -> TrueCrops:
    """Crop an object out of cluttered scenes.

    Args:
        mesh: the object.
        seeds: of the scenes, one for each crop; see :func:`foundpose.synthetic.cluttered_scene`.
        crop: cuts the crops, focused on the visible part's mask.
        renderer: draws the object.
        light: how the light varies between scenes.
        occlusion: hide a corner of the object in each scene.
        size: height and width of a scene in pixels.

    Raises:
        ValueError: there are no seeds.
    """
    if len(seeds) == 0:
        raise ValueError("there is nothing to render: seeds is empty")
    scenes = [cluttered_scene(mesh, seed, *size, occlusion, renderer, light) for seed in seeds]
    image, K, mask, T_camera_from_model = (torch.stack(parts) for parts in zip(*scenes, strict=True))
    crops = crop(image, K, mask)
    return TrueCrops(crops, crops.T_crop_from_camera @ T_camera_from_model)


def nearby_rotations(
    rotations: Tensor, min_degrees: float, max_degrees: float, generator: torch.Generator
) -> Tensor:
    """Turn rotations (B, 3, 3) about random axes by angles drawn evenly between two bounds.

    Raises:
        ValueError: bounds that are not ``0 <= min_degrees <= max_degrees <= 180``.
    """
    if not 0.0 <= min_degrees <= max_degrees <= 180.0:
        raise ValueError(f"need 0 <= min_degrees <= max_degrees <= 180, got {min_degrees} and {max_degrees}")
    axis = F.normalize(torch.randn(len(rotations), 3, generator=generator), dim=-1)
    share = torch.rand(len(rotations), 1, generator=generator)
    angle = math.radians(min_degrees) + math.radians(max_degrees - min_degrees) * share
    return axis_angle_to_rotation_matrix(axis * angle).to(rotations) @ rotations


def render_templates(mesh: Mesh, rotations: Tensor, onboarder: Onboarder) -> TemplateViews:
    """Render templates of given orientations (B, 3, 3), with the onboarder's settings."""
    size, extractor = onboarder.image_size, onboarder.extractor
    cameras = template_cameras(mesh, rotations, size, onboarder.fill, onboarder.distance)
    render = onboarder.renderer(mesh, *cameras, (size, size))
    patches = register_patches(
        onboarder.renderer,
        mesh,
        cameras,
        render.mask,
        extractor.patch_grid(size),
        onboarder.mask_erosion,
    )
    return TemplateViews(render.rgb, patches)

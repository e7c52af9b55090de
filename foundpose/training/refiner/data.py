"""Pictures of objects with perturbed poses: what a learned refiner is trained and measured on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.utils.data import Dataset

from foundpose.geometry import PerspectiveCrop, make_transform, transform_points
from foundpose.onboarding import Progress
from foundpose.refinement import PicturedObjects
from foundpose.rendering import Mesh, Renderer
from foundpose.synthetic import LightVariation, combine_seeds
from foundpose.training.base import RenderedDataModule
from foundpose.training.views import render_crops

_CHUNK = 16  # scenes that are drawn at a time


@dataclass(frozen=True)
class Perturbation:
    """How far initial poses are from the truth; standard deviations of normal distributions.

    Args:
        rotation: about each of the camera's axes, degrees.
        lateral: shift of the object's centre in x and y, as a share of its depth.
        depth: logarithm of the ratio of depths, so 0.05 is about 5 %.

    Raises:
        ValueError: a negative number.
    """

    rotation: float = 15.0
    lateral: float = 0.02
    depth: float = 0.05

    def __post_init__(self) -> None:
        if not min(self.rotation, self.lateral, self.depth) >= 0.0:
            raise ValueError(
                "rotation, lateral and depth must not be negative, got "
                f"{self.rotation}, {self.lateral} and {self.depth}"
            )

    def __call__(self, T_camera_from_model: Tensor, centre: Tensor, seeds: Sequence[int]) -> Tensor:
        """Perturb poses (B, 4, 4) of objects with centres (B, 3); each by a draw of its own seed."""
        draws = torch.stack([torch.randn(6, generator=torch.Generator().manual_seed(seed)) for seed in seeds])
        draws = draws.to(T_camera_from_model)
        turn = axis_angle_to_rotation_matrix(math.radians(self.rotation) * draws[:, :3])
        R = turn @ T_camera_from_model[:, :3, :3]
        x, y, z = transform_points(T_camera_from_model, centre.unsqueeze(1)).squeeze(1).unbind(-1)
        depth = z * torch.exp(self.depth * draws[:, 5])
        moved = torch.stack([x / z + self.lateral * draws[:, 3], y / z + self.lateral * draws[:, 4]], -1)
        moved = torch.cat([moved * depth[:, None], depth[:, None]], dim=-1)
        return make_transform(R, moved - (R @ centre.unsqueeze(-1)).squeeze(-1))


@dataclass(frozen=True)
class PictureSettings:
    """The pictures.

    Args:
        pictures_per_mesh: number of scenes of each mesh.
        size: side of a picture in pixels: the part of the scene around the object.
        fill: share of the side that the visible part of the object takes.
        occlusion: hide a corner of the object.
        light: how the light varies; None for always the same.
        scene: height and width of the scenes in pixels; the object takes about half of the height.

    Raises:
        ValueError: no pictures.
    """

    pictures_per_mesh: int = 60
    size: int = 176
    fill: float = 0.45
    occlusion: bool = True
    light: LightVariation | None = None
    scene: tuple[int, int] = (240, 320)

    def __post_init__(self) -> None:
        if self.pictures_per_mesh < 1:
            raise ValueError(f"pictures_per_mesh must be at least 1, got {self.pictures_per_mesh}")


class RefinerBatch(NamedTuple):
    """B pictures with true and perturbed poses.

    Attributes:
        pictured: one picture for each.
        T_true: (B, 4, 4) ``T_camera_from_model``, mesh units.
        T_start: (B, 4, 4) the perturbed ones.
        surface: (B, P, 3) points of the surface, mesh units.
        diameter: (B,) mesh units.
    """

    pictured: PicturedObjects
    T_true: Tensor
    T_start: Tensor
    surface: Tensor
    diameter: Tensor


class RefinerPictures(Dataset[RefinerBatch]):
    """Pictures in memory; item k is picture ``k % count`` with the k-th perturbation, so there is no last item.

    Args:
        meshes: the objects.
        settings: of the pictures.
        perturbation: of the poses.
        renderer: draws the scenes.
        seed: of scenes and perturbations.
        surface_points: points of each mesh for the loss.
        progress: is told how far rendering has come.

    Raises:
        ValueError: no meshes.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        settings: PictureSettings,
        perturbation: Perturbation,
        renderer: Renderer,
        seed: int = 0,
        surface_points: int = 256,
        progress: Progress | None = None,
    ) -> None:
        if not meshes:
            raise ValueError("meshes is empty: give at least one")
        self.meshes = list(meshes)
        self.perturbation = perturbation
        self.seed = seed
        crop = PerspectiveCrop(settings.size, settings.fill)
        count = settings.pictures_per_mesh
        pictures, cameras, poses = [], [], []
        for number, mesh in enumerate(self.meshes):
            for start in range(0, count, _CHUNK):
                seeds = [combine_seeds(seed, number, k) for k in range(start, min(start + _CHUNK, count))]
                found = render_crops(
                    mesh, seeds, crop, renderer, settings.light, settings.occlusion, settings.scene
                )
                pictures.append((found.crops.images * 255.0).round().to(torch.uint8))
                cameras.append(found.crops.K_crop)
                poses.append(found.T_crop_from_model)
                if progress is not None:
                    progress("pictures", number * count + start + len(seeds), len(self.meshes) * count)
        self.images = torch.cat(pictures)
        self.K = torch.cat(cameras)
        self.T_true = torch.cat(poses)
        self.mesh_index = torch.arange(len(self.meshes)).repeat_interleave(count)
        self.surface = torch.stack([_spread(mesh.vertices, surface_points) for mesh in self.meshes])
        self.diameter = torch.tensor([mesh.diameter for mesh in self.meshes])
        self.centre = torch.stack([mesh.bounds.mean(0) for mesh in self.meshes])

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.images)

    def __getitem__(self, k: int) -> RefinerBatch:
        """Item k as a batch of one."""
        return self.__getitems__([k])

    def __getitems__(self, keys: Sequence[int]) -> RefinerBatch:
        """Several items as a batch."""
        rows = torch.tensor([k % len(self) for k in keys])
        mesh_index, T_true = self.mesh_index[rows], self.T_true[rows]
        seeds = [combine_seeds(self.seed, 1, k) for k in keys]
        return RefinerBatch(
            pictured=PicturedObjects(
                self.images[rows].float() / 255.0,
                self.K[rows],
                torch.arange(len(rows)),
                self.meshes,
                mesh_index,
            ),
            T_true=T_true,
            T_start=self.perturbation(T_true, self.centre[mesh_index], seeds),
            surface=self.surface[mesh_index],
            diameter=self.diameter[mesh_index],
        )


class RefinerDataModule(RenderedDataModule):
    """Renders the pictures once, at first need, and deals them out in batches with ever new perturbations.

    Args:
        meshes: objects to train on.
        validation_meshes: other objects, for the validation loss; may be empty.
        renderer: draws the scenes.
        pictures: what the pictures are like.
        perturbation: of the poses.
        batch_size: pictures in a batch.
        passes: how often each picture is shown in an epoch.
        seed: of scenes, perturbations and order.
        surface_points: points of each mesh for the loss.
        progress: is told how far rendering has come.

    Raises:
        ValueError: no meshes, no batch or no pass.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        validation_meshes: Sequence[Mesh],
        renderer: Renderer,
        pictures: PictureSettings,
        perturbation: Perturbation,
        batch_size: int = 32,
        passes: int = 1,
        seed: int = 0,
        surface_points: int = 256,
        progress: Progress | None = None,
    ) -> None:
        super().__init__(meshes, validation_meshes, batch_size, passes, seed)
        self.renderer = renderer
        self.pictures = pictures
        self.perturbation = perturbation
        self.surface_points = surface_points
        self.progress = progress

    def render(self, validation: bool) -> RefinerPictures:
        """Render the pictures."""
        return RefinerPictures(
            self.validation_meshes if validation else self.meshes,
            self.pictures,
            self.perturbation,
            self.renderer,
            combine_seeds(self.seed, 1) if validation else self.seed,
            self.surface_points,
            self.progress,
        )


def _spread(vertices: Tensor, count: int) -> Tensor:
    """``count`` of the vertices at even steps; small meshes repeat theirs."""
    return vertices[torch.linspace(0, len(vertices) - 1, count).round().long()]

"""Procedural objects and cluttered pictures of them, for demos, tests and training without data."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from PIL import Image, ImageDraw
from torch import Tensor

from foundpose.geometry import (
    grow_masks,
    intrinsics_matrix,
    make_transform,
    pixel_rays,
    project_to_rotation,
)
from foundpose.rendering import Mesh, RaycastRenderer, Renderer

_HIDDEN = 0.12


class SyntheticScene(NamedTuple):
    """A picture with known truth.

    Attributes:
        image: (3, H, W) in [0, 1].
        K: (3, 3) intrinsics.
        mask: (H, W) bool, visible part of the object.
        T_camera_from_model: (4, 4) true pose.
    """

    image: Tensor
    K: Tensor
    mask: Tensor
    T_camera_from_model: Tensor


@dataclass(frozen=True)
class LightVariation:
    """How the light on an object and the camera's response vary from picture to picture; ranges are (low, high).

    Args:
        ambient: share of the light that comes from everywhere; the rest comes from one lamp.
        tilt: largest angle between the lamp's direction and the camera's axis, degrees.
        brightness: of the whole picture.
        gain: of each colour channel.
        noise: standard deviation of a pixel's value.

    Raises:
        ValueError: a range that is not one, or values that no light has.
    """

    ambient: Sequence[float] = (0.25, 0.9)
    tilt: float = 70.0
    brightness: Sequence[float] = (0.5, 1.2)
    gain: Sequence[float] = (0.85, 1.1)
    noise: Sequence[float] = (0.0, 0.03)

    def __post_init__(self) -> None:
        for name in ("ambient", "brightness", "gain", "noise"):
            bounds = getattr(self, name)
            if len(bounds) != 2 or not 0.0 <= bounds[0] <= bounds[1]:
                raise ValueError(f"{name} must be (low, high) with 0 <= low <= high, got {tuple(bounds)}")
            object.__setattr__(
                self, name, tuple(bounds)
            )  # files are named after it, whatever sequence was given
        if self.ambient[1] > 1.0 or not 0.0 <= self.tilt <= 90.0:
            raise ValueError(
                f"ambient must not exceed 1 and tilt lie in [0, 90] degrees, got {tuple(self.ambient)} "
                f"and {self.tilt}"
            )


def procedural_mesh(seed: int, diameter: float = 120.0, subdivisions: int = 6) -> Mesh:
    """A smooth, irregular body with a fine-grained coloured pattern, different for every seed.

    Args:
        seed: any integer.
        diameter: about the size of the body, in the unit that the mesh shall have.
        subdivisions: of an icosahedron; 6 gives 41 k vertices.
    """
    generator = torch.Generator().manual_seed(seed)
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions = torch.from_numpy(np.array(sphere.vertices, dtype=np.float64))

    def waves(count: int, frequency: float) -> Tensor:
        """A random smooth function on the sphere with values of about unit size."""
        k = torch.randn(3, count, generator=generator, dtype=torch.float64) * frequency
        phase = torch.rand(count, generator=generator, dtype=torch.float64) * 2 * math.pi
        return torch.cos(directions @ k + phase).mean(dim=1) * math.sqrt(2 * count)

    radius = 1.0 + 0.10 * waves(12, 2.0) + 0.02 * waves(24, 5.0)
    stretch = 0.6 + 0.5 * torch.rand(3, generator=generator, dtype=torch.float64)
    vertices = directions * radius.clamp(min=0.4)[:, None] * stretch
    extent = (vertices.amax(0) - vertices.amin(0)).max()
    vertices = vertices * (diameter / extent)

    # Cells of two sizes, each with a colour of its own: corners and edges at the scales of the patches. The cells'
    # brightness differs as much as their hue, for descriptors that see grey only.
    color = torch.ones(len(vertices), 3, dtype=torch.float64)
    for cells, darkest in ((60, 0.25), (350, 0.15)):
        centres = F.normalize(torch.randn(cells, 3, generator=generator, dtype=torch.float64), dim=1)
        hue = 0.5 + 0.5 * torch.rand(cells, 3, generator=generator, dtype=torch.float64)
        value = (
            darkest + (1 - darkest) * torch.rand(cells, 1, generator=generator, dtype=torch.float64).round()
        )
        color *= (hue * value)[(directions @ centres.T).argmax(dim=1)]
    color = color.sqrt()
    return Mesh(
        vertices=vertices.float(),
        faces=torch.from_numpy(np.array(sphere.faces, dtype=np.int64)),
        vertex_colors=color.float(),
    )


def combine_seeds(*numbers: int) -> int:
    """One seed of 32 bits from several integers, another for other integers or another order.

    PyTorch's generator on the CPU reads no more than the lowest 32 bits of a seed.
    """
    words = [number % (1 << 64) for number in numbers]
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def random_rotation(generator: torch.Generator) -> Tensor:
    """A uniformly random rotation (3, 3), float64."""
    # The rotation nearest to a Gaussian matrix is uniform on SO(3), up to reflections, which are turned over.
    return project_to_rotation(torch.randn(3, 3, generator=generator, dtype=torch.float64))


def cluttered_scene(
    mesh: Mesh,
    seed: int,
    height: int = 480,
    width: int = 640,
    occlusion: bool | float = True,
    renderer: Renderer | None = None,
    light: LightVariation | None = None,
) -> SyntheticScene:
    """Picture of an object in front of and behind clutter, under another light than the templates', with noise.

    Args:
        mesh: the object.
        seed: of everything that is random.
        height: of the picture in pixels.
        width: of the picture in pixels.
        occlusion: hide a corner of the object, an eighth of it or such a share.
        renderer: draws the object; by default a ray caster with much ambient light.
        light: how much the light varies; the share of ambient light is then the light's, not the renderer's. The
            object, its pose and the clutter stay what they are without.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    focal = 0.95 * width
    K = intrinsics_matrix(focal, focal, width / 2 - 0.5 + uniform(-9, 9), height / 2 - 0.5 + uniform(-9, 9))
    # The object takes about half of the picture's height.
    distance = mesh.diameter * focal / (0.5 * height) * uniform(0.85, 1.25)
    pixel = torch.tensor([[width * uniform(0.3, 0.7), height * uniform(0.35, 0.65)]])
    R = random_rotation(generator)
    centre = (mesh.bounds[0] + mesh.bounds[1]).double() / 2
    t = (pixel_rays(pixel, K)[0] * distance).double() - R @ centre
    T = make_transform(R, t).float()

    renderer = renderer or RaycastRenderer(ambient=0.75)
    if light is None:
        render = renderer(mesh, T[None], K[None], (height, width))
        shown = render.rgb[0]
    else:
        lamp = torch.Generator().manual_seed(combine_seeds(seed, 1))
        with _ambient_light_only(renderer):
            render = renderer(mesh, T[None], K[None], (height, width))
        shown = _shine(render.rgb[0], render.normals[0], light, lamp)
    mask = render.mask[0]
    image = torch.where(mask, shown, _clutter(height, width, generator, shapes=150))
    if occlusion:
        share = _HIDDEN if occlusion is True else occlusion
        image, mask = _hide_corner(image, mask, generator, share)
    gain = torch.tensor([uniform(0.85, 1.1) for _ in range(3)])[:, None, None]
    noise = 0.015
    if light is not None:
        gain = _draw(light.gain, 3, lamp)[:, None, None] * _draw(light.brightness, 1, lamp)
        noise = float(_draw(light.noise, 1, lamp))
    image = image * gain + noise * torch.randn(image.shape, generator=generator)
    return SyntheticScene(image.clamp(0, 1), K, mask, T)


@contextmanager
def _ambient_light_only(renderer: Renderer) -> Iterator[None]:
    """Take the renderer's lamp away for a while. (A copy would have to set up its own meshes and GL context.)"""
    before, renderer.ambient = renderer.ambient, 1.0
    try:
        yield
    finally:
        renderer.ambient = before


def _shine(albedo: Tensor, normals: Tensor, light: LightVariation, generator: torch.Generator) -> Tensor:
    """Light a picture (3, H, W) without shading by a distant lamp from somewhere; normals as in RenderOutput."""
    ambient = _draw(light.ambient, 1, generator)
    tilt, azimuth = torch.deg2rad(
        torch.cat([_draw((0.0, light.tilt), 1, generator), _draw((0, 360), 1, generator)])
    )
    to_lamp = torch.stack([tilt.sin() * azimuth.cos(), tilt.sin() * azimuth.sin(), -tilt.cos()])
    cosine = (normals * to_lamp[:, None, None]).sum(0).clamp(min=0.0)
    return albedo * (ambient + (1.0 - ambient) * cosine)


def _draw(bounds: Sequence[float], count: int, generator: torch.Generator) -> Tensor:
    """``count`` numbers between two bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * torch.rand(count, generator=generator)


def _clutter(height: int, width: int, generator: torch.Generator, shapes: int) -> Tensor:
    """A picture full of coloured shapes."""
    draws = torch.rand(shapes, 8, generator=generator).tolist()
    picture = Image.new("RGB", (width, height), (90, 95, 100))
    draw = ImageDraw.Draw(picture)
    for x, y, w, h, red, green, blue, kind in draws:
        box = (x * width - 40 * w, y * height - 40 * h, x * width + 5 + 60 * w, y * height + 5 + 60 * h)
        color = (int(255 * red), int(255 * green), int(255 * blue))
        if kind < 0.4:
            draw.rectangle(box, fill=color)
        elif kind < 0.8:
            draw.ellipse(box, fill=color)
        else:
            draw.line(box, fill=color, width=3)
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0).permute(2, 0, 1)


def _hide_corner(
    image: Tensor, mask: Tensor, generator: torch.Generator, share: float
) -> tuple[Tensor, Tensor]:
    """Put a flat shape over about such a share of the object."""
    rows, columns = torch.nonzero(mask, as_tuple=True)
    angle = 2 * math.pi * float(torch.rand((), generator=generator))
    along = columns * math.cos(angle) + rows * math.sin(angle)
    hidden = along > along.float().quantile(1.0 - share)
    cover = torch.zeros_like(mask)
    cover[rows[hidden], columns[hidden]] = True
    cover = grow_masks(cover, 4)
    color = torch.rand(3, 1, 1, generator=generator)
    return torch.where(cover, color, image), mask & ~cover

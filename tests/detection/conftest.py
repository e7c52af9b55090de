"""Two objects of different colours in one picture, and an extractor that sees colours."""

from typing import NamedTuple

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.features import PatchExtractor, PatchFeatures, PcaProjection
from foundpose.features.base import Fingerprint
from foundpose.geometry import SuperFibonacci, intrinsics_matrix, make_transform
from foundpose.onboarding import Onboarder
from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SoftAssignBow, VisualWords
from foundpose.synthetic import procedural_mesh

SIDE = 140  # of crops and templates
PICTURE = (240, 320)
K = intrinsics_matrix(300.0, 300.0, 159.5, 119.5)
TINTS = {"red": (0.9, 0.15, 0.1), "blue": (0.1, 0.2, 0.9), "green": (0.1, 0.8, 0.2)}


class Colors(PatchExtractor):
    """Mean colour of a patch, and its deviation; the picture's mean as the global descriptor."""

    def __init__(self) -> None:
        super().__init__(6, stride=14, offset=6.5)
        self.register_buffer("nothing", torch.zeros(1))

    def forward(self, images: Tensor) -> PatchFeatures:
        mean = F.avg_pool2d(images, 14)
        deviation = (F.avg_pool2d(images**2, 14) - mean**2).clamp_min(1e-8).sqrt()
        return PatchFeatures(torch.cat([mean, deviation], 1), images.mean(dim=(2, 3)))

    def fingerprint(self) -> Fingerprint:
        return {"extractor": "Colors"}


class Scene(NamedTuple):
    """A picture of a red object twice and a blue one before grey; a green one is not there."""

    image: Tensor
    masks: Tensor
    labels: list[str]
    objects: dict[str, ObjectRepresentation]


@pytest.fixture(scope="session")
def scene() -> Scene:
    renderer = RaycastRenderer(ambient=1.0)
    onboarder = Onboarder(
        renderer,
        Colors(),
        SuperFibonacci(12),
        VisualWords(8),
        SoftAssignBow(sigma=0.1),
        projection=PcaProjection(4),
        image_size=SIDE,
    )
    meshes, objects = {}, {}
    for seed, (name, tint) in enumerate(TINTS.items()):
        body = procedural_mesh(seed, subdivisions=3)
        colors = 0.15 * body.vertex_colors + 0.85 * torch.tensor(tint)
        meshes[name] = Mesh(body.vertices, body.faces, vertex_colors=colors)
        objects[name] = onboarder(meshes[name], name)
    labels = ["red", "red", "blue"]
    places = [(-150.0, -60.0, 600.0), (150.0, 70.0, 620.0), (40.0, -90.0, 640.0)]
    image = torch.full((3, *PICTURE), 0.5)
    masks = []
    for name, place in zip(labels, places, strict=True):
        T = make_transform(torch.eye(3), torch.tensor(place))
        drawn = renderer(meshes[name], T[None], K[None], PICTURE)
        image = torch.where(drawn.mask, drawn.rgb[0], image)
        masks.append(drawn.mask[0])
    return Scene(image, torch.stack(masks), labels, objects)

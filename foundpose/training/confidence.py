"""Rendered pictures with what speaks for the poses found in them, and which poses are right."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.bop.errors import mspd
from foundpose.geometry import grow_masks
from foundpose.pipeline import RIGHT_PIXELS, FoundPose, PoseEvidence
from foundpose.rendering import Mesh, Renderer
from foundpose.representation import ObjectRepresentation
from foundpose.synthetic import LightVariation, SyntheticScene, cluttered_scene, combine_seeds

_HEIGHT, _WIDTH = 480, 640


@dataclass(frozen=True)
class ConfidencePictures:
    """Pictures to calibrate with: an object of some size, hidden in part, with a mask that is not quite right.

    Args:
        heights: (low, high) pixels of what surrounds the object, which takes half of it, in a picture of 640x480; the
            logarithm is uniform.
        hidden: (low, high) share of the object that something hides.
        mask_error: largest number of pixels by which a mask is grown or shrunk.
        absent: share of pictures that show another object in the mask.
        light: how the light varies; None: hardly.

    Raises:
        ValueError: ranges that are none.
    """

    heights: Sequence[float] = (80.0, 400.0)
    hidden: Sequence[float] = (0.0, 0.4)
    mask_error: int = 2
    absent: float = 0.1
    light: LightVariation | None = field(default_factory=LightVariation)

    def __post_init__(self) -> None:
        if not 16 <= self.heights[0] <= self.heights[1] <= _HEIGHT:
            raise ValueError(f"heights must be (low, high) within 16 and {_HEIGHT}, got {self.heights}")
        if not 0 <= self.hidden[0] <= self.hidden[1] < 1:
            raise ValueError(f"hidden must be (low, high) within 0 and 1, got {self.hidden}")
        if self.mask_error < 0 or not 0 <= self.absent < 1:
            raise ValueError(
                f"mask_error must be at least 0 and absent within 0 and 1, got {self.mask_error} and {self.absent}"
            )

    def draw(
        self, mesh: Mesh, others: Sequence[Mesh], seed: int, renderer: Renderer
    ) -> SyntheticScene | None:
        """A picture (3, 480, 640) of a mesh, or of one of the others; None where nothing is left to see.

        The true pose of a picture of another is NaN.
        """
        generator = torch.Generator().manual_seed(combine_seeds(seed, 2))
        a, b, c, d, e, f = torch.rand(6, generator=generator).tolist()
        low, high = map(math.log, self.heights)
        height = round(math.exp(low + a * (high - low)))
        absent = bool(others) and b < self.absent
        shown = others[int(c * len(others))] if absent else mesh
        hidden = self.hidden[0] + d * (self.hidden[1] - self.hidden[0])
        width = height * 4 // 3
        scene = cluttered_scene(shown, seed, height, width, hidden, renderer, self.light)
        mask = grow_masks(scene.mask, round((2.0 * e - 1.0) * self.mask_error))
        if int(mask.sum()) < 16:
            return None
        left, top = int(f * (_WIDTH - width)), int(f * (_HEIGHT - height))
        pad = (left, _WIDTH - width - left, top, _HEIGHT - height - top)
        K = scene.K.clone()
        K[:2, 2] += torch.tensor([left, top])
        T = torch.full_like(scene.T_camera_from_model, torch.nan) if absent else scene.T_camera_from_model
        return SyntheticScene(F.pad(scene.image, pad), K, F.pad(mask, pad), T)


@torch.no_grad()
def collect_evidence(
    pipeline: FoundPose,
    representation: ObjectRepresentation,
    mesh: Mesh,
    scenes: Iterator[SyntheticScene],
    batch_size: int = 8,
) -> tuple[PoseEvidence, Tensor]:
    """Estimate an object's pose in pictures, and compare with the truth.

    Args:
        pipeline: the method, with a confidence, whose numbers do not matter.
        representation: the object.
        mesh: the object, without symmetries.
        scenes: pictures of one size, 640 px wide; those whose true pose is NaN do not show it.
        batch_size: pictures at a time.

    Returns:
        What speaks for each pose that was found, and which of them (N,) are right.

    Raises:
        ValueError: the pipeline has no confidence.
    """
    if pipeline.confidence is None:
        raise ValueError("the pipeline has no confidence, which collects the evidence: give it any")
    device = representation.points_model.device
    evidence, right = [], []
    while batch := list(islice(scenes, batch_size)):
        images, K, masks, T_true = (torch.stack(field).to(device) for field in zip(*batch, strict=True))
        estimates = pipeline(images, K, representation, masks=masks, meshes=mesh)
        assert estimates.evidence is not None
        error = mspd(estimates.T_camera_from_model, T_true, K, mesh.vertices.to(device))
        evidence.append(PoseEvidence(*(part[estimates.valid].cpu() for part in estimates.evidence)))
        right.append((error < RIGHT_PIXELS)[estimates.valid].cpu())
    return PoseEvidence(*map(torch.cat, zip(*evidence, strict=True))), torch.cat(right)

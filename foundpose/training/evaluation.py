"""How right the poses of rendered scenes are, before and after training."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry import Symmetries, rotation_angle
from foundpose.losses import geodesic_rotation_error, point_matching_error
from foundpose.losses.alignment import best_symmetry
from foundpose.losses.points import nearest_angles_of_points
from foundpose.losses.reduction import mean_norm, place_points
from foundpose.onboarding import Progress
from foundpose.pipeline import FoundPose
from foundpose.rendering import Mesh, Renderer
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import QueryPatches, RetrievedTemplates, Retriever
from foundpose.synthetic import LightVariation, cluttered_scene

RIGHT_DEGREES = 10.0
RIGHT_DIAMETERS = 0.1


class SceneErrors(NamedTuple):
    """Errors of N poses, against whichever of the equivalent true poses of a symmetric object is nearest.

    Attributes:
        rotation: (N,) degrees; 180 where no pose was found.
        translation: (N,) diameters; infinite where no pose was found. The nearest true pose is here the one of the
            least mean squared distance of the model's points.
        matching: (N,) mean distance of the model's points in diameters, at most 1; 1 where no pose was found.
        right: (N,) bool, within 10 degrees and a tenth of the diameter.
    """

    rotation: Tensor
    translation: Tensor
    matching: Tensor
    right: Tensor


class GivenTemplates(Retriever):
    """Returns the templates that it was told to.

    Attributes:
        index: (B, h) templates of the next batch of crops.
    """

    def __init__(self) -> None:
        super().__init__()
        self.index = torch.zeros(0, 1, dtype=torch.int64)

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """The given templates, all equally similar."""
        if len(self.index) != len(query.valid):
            raise ValueError(f"templates are given for {len(self.index)} crops, there are {len(query.valid)}")
        chosen = self.index.to(query.valid.device)
        ok = query.valid.any(dim=1, keepdim=True).expand_as(chosen)
        return RetrievedTemplates(chosen, query.descriptors.new_ones(chosen.shape), ok)


@torch.no_grad()  # a measurement
def evaluate_scenes(
    pipeline: FoundPose,
    representation: ObjectRepresentation,
    mesh: Mesh,
    seeds: Sequence[int],
    renderer: Renderer,
    light: LightVariation | None = None,
    occlusion: bool = True,
    batch_size: int = 8,
    progress: Progress | None = None,
    symmetries: Symmetries | None = None,
) -> dict[str, SceneErrors]:
    """Estimate an object's pose in cluttered scenes.

    Args:
        pipeline: the method; measured in eval mode, and left as it was.
        representation: the object, onboarded.
        mesh: the object.
        seeds: one scene each.
        renderer: draws the scenes.
        light: how their light varies.
        occlusion: hide a corner of the object.
        batch_size: scenes at a time.
        progress: is told of every batch.
        symmetries: of the object, one entry; None: it has none, so that a pose which only looks right is wrong.

    Returns:
        Errors with the "retrieved" templates, and with the "nearest" one given, which leaves out retrieval.
    """
    with _eval_mode(pipeline):
        given = GivenTemplates()
        told = FoundPose(
            pipeline.crop,
            pipeline.extractor,
            given,
            pipeline.hypotheses,
            pipeline.refiner,
            pipeline.refine,
        ).eval()
        device = representation.points_model.device
        parts: dict[str, list[SceneErrors]] = {"retrieved": [], "nearest": []}
        for start in range(0, len(seeds), batch_size):
            chunk = seeds[start : start + batch_size]
            scenes = [
                cluttered_scene(mesh, s, occlusion=occlusion, renderer=renderer, light=light) for s in chunk
            ]
            image, K, mask, T_true = (torch.stack(field).to(device) for field in zip(*scenes, strict=True))
            found = pipeline(image, K, representation, masks=mask, meshes=mesh)
            T_crop = found.crops.T_crop_from_camera @ T_true
            R_template = representation.T_template_from_model[:, :3, :3]
            given.index = rotation_angle(T_crop[:, None, :3, :3], R_template[None]).argmin(
                dim=1, keepdim=True
            )
            helped = told(image, K, representation, masks=mask, meshes=mesh)
            for name, estimates in (("retrieved", found), ("nearest", helped)):
                parts[name].append(
                    pose_errors(estimates.T_camera_from_model, estimates.valid, T_true, mesh, symmetries)
                )
            if progress is not None:
                progress("scenes", start + len(chunk), len(seeds))
    return {
        name: SceneErrors(*(torch.cat(field) for field in zip(*errors, strict=True)))
        for name, errors in parts.items()
    }


@contextmanager
def _eval_mode(module: nn.Module) -> Iterator[None]:
    """Put a module in eval mode, and afterwards every part of it back into its own."""
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for part, training in modes:
            part.training = training


def pose_errors(
    T_est: Tensor, valid: Tensor, T_true: Tensor, mesh: Mesh, symmetries: Symmetries | None = None
) -> SceneErrors:
    """Errors of poses (N, 4, 4) against true ones, on the CPU; no pose has the largest errors.

    ``symmetries`` are those of the object, one entry; None: it has none.
    """
    T_est, valid, T_true = T_est.cpu(), valid.cpu(), T_true.cpu()
    diameter = float(mesh.diameter)
    points = mesh.vertices[:: max(1, len(mesh.vertices) // 1000)].to(T_est)
    T_nearest = T_true
    if symmetries is not None:
        symmetries = symmetries.to("cpu", T_est.dtype).gather(torch.zeros(len(T_est), dtype=torch.int64))
        T_nearest = _nearest_truth(T_est, T_true, symmetries, points[None])
    rotation = torch.rad2deg(geodesic_rotation_error(T_est, T_true, symmetries))
    rotation = torch.where(valid, rotation, 180.0)
    distance = torch.linalg.vector_norm(T_est[:, :3, 3] - T_nearest[:, :3, 3], dim=-1) / diameter
    distance = torch.where(valid, distance, torch.inf)
    matching = point_matching_error(T_est, T_true, points, symmetries, norm="l2") / diameter
    matching = torch.where(valid, matching, torch.inf).clamp(max=1.0)
    return SceneErrors(
        rotation, distance, matching, (rotation < RIGHT_DEGREES) & (distance < RIGHT_DIAMETERS)
    )


def _nearest_truth(T_est: Tensor, T_true: Tensor, symmetries: Symmetries, points: Tensor) -> Tensor:
    """The equivalent true poses that bring points (1, M, 3) nearest to the estimates, by mean squared distance."""
    angles = nearest_angles_of_points(T_est, T_true, symmetries, points)

    def error(S: Tensor) -> Tensor:
        return mean_norm(place_points(T_est[:, None] - T_true[:, None] @ S, points), "squared")

    return T_true @ best_symmetry(error, symmetries, angles, refine=False)


def summarize(errors: SceneErrors) -> dict[str, float]:
    """Share of right poses with its standard error, median rotation error and mean matching error with its own."""
    count = len(errors.right)
    share = float(errors.right.float().mean())
    return {
        "scenes": count,
        "right": share,
        "right_standard_error": (share * (1 - share) / count) ** 0.5,
        "median_rotation_degrees": float(errors.rotation.median()),
        "mean_matching_error": float(errors.matching.mean()),
        "matching_standard_error": float(errors.matching.std(correction=0)) / count**0.5,
    }


def compare(before: SceneErrors, after: SceneErrors) -> dict[str, float]:
    """Differences after minus before on the same scenes, with the standard errors of paired differences.

    ``gained`` and ``lost`` count the scenes whose pose became right or wrong.
    """
    if len(before.right) != len(after.right):
        raise ValueError(f"these are {len(before.right)} and {len(after.right)} scenes, not the same ones")
    count = len(before.right)
    right = after.right.float() - before.right.float()
    matching = after.matching - before.matching
    return {
        "gained": int((right > 0).sum()),
        "lost": int((right < 0).sum()),
        "right": float(right.mean()),
        "right_standard_error": float(right.std(correction=0)) / count**0.5,
        "mean_matching_error": float(matching.mean()),
        "matching_standard_error": float(matching.std(correction=0)) / count**0.5,
    }

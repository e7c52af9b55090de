"""How right the poses of an object in rendered scenes are."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice

import torch
from torch import Tensor, nn

from foundpose.geometry import Symmetries, pose_deviation, rotation_angle
from foundpose.losses import geodesic_rotation_error, point_matching_error
from foundpose.losses.alignment import nearest_truth
from foundpose.losses.reduction import mean_norm, place_points
from foundpose.pipeline import FoundPose
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import QueryPatches, RetrievedTemplates, Retriever
from foundpose.synthetic import SyntheticScene
from foundpose.training.errors import PoseErrors, join_errors


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
    scenes: Iterable[SyntheticScene],
    batch_size: int = 8,
    symmetries: Symmetries | None = None,
) -> dict[str, PoseErrors]:
    """Estimate an object's pose in pictures with known truth.

    Args:
        pipeline: the method; measured in eval mode, and left as it was.
        representation: the object, onboarded.
        mesh: the object.
        scenes: the pictures; taken one batch at a time.
        batch_size: pictures at a time.
        symmetries: of the object, one entry; None: it has none, so that a pose which only looks right is wrong.

    Returns:
        Errors with the "retrieved" templates, and with the "nearest" one given, which leaves out retrieval.
    """
    given = GivenTemplates()
    told = FoundPose(
        pipeline.crop, pipeline.extractor, given, pipeline.hypotheses, pipeline.refiner, pipeline.refine
    )
    R_template = representation.T_template_from_model[:, :3, :3]
    parts: dict[str, list[PoseErrors]] = {"retrieved": [], "nearest": []}
    left = iter(scenes)
    with _eval_mode(pipeline):
        while chunk := list(islice(left, batch_size)):
            image, K, mask, T_true = (
                torch.stack(field).to(R_template.device) for field in zip(*chunk, strict=True)
            )
            found = pipeline(image, K, representation, masks=mask, meshes=mesh)
            T_crop = found.crops.T_crop_from_camera @ T_true
            angles = rotation_angle(T_crop[:, None, :3, :3], R_template[None])
            given.index = angles.argmin(dim=1, keepdim=True)
            helped = told(image, K, representation, masks=mask, meshes=mesh)
            for name, estimates in (("retrieved", found), ("nearest", helped)):
                parts[name].append(
                    pose_errors(estimates.T_camera_from_model, estimates.valid, T_true, mesh, symmetries)
                )
    return {name: join_errors(errors) for name, errors in parts.items()}


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
) -> PoseErrors:
    """Errors of poses (N, 4, 4) against true ones, on the CPU; no pose has the largest errors.

    ``symmetries`` are those of the object, one entry; None: it has none. Of equivalent true poses, a displacement is
    from the one of the least mean squared distance of the model's points.
    """
    T_est, valid, T_true = T_est.cpu(), valid.cpu(), T_true.cpu()
    diameter = float(mesh.diameter)
    points = mesh.vertices[:: max(1, len(mesh.vertices) // 1000)].to(T_est)
    T_nearest = T_true
    if symmetries is not None:
        symmetries = symmetries.to("cpu", T_est.dtype).gather(torch.zeros(len(T_est), dtype=torch.int64))
        T_nearest = nearest_truth(
            lambda T: mean_norm(place_points(T_est[:, None] - T, points[None]), "squared"),
            T_est,
            T_true,
            symmetries,
            points[None],
        )
    _, lateral, depth = pose_deviation(T_est, T_nearest, diameter)
    rotation = torch.rad2deg(geodesic_rotation_error(T_est, T_true, symmetries))
    matching = point_matching_error(T_est, T_true, points, symmetries, norm="l2") / diameter
    return PoseErrors(
        torch.where(valid, rotation, 180.0),
        torch.where(valid, lateral, torch.inf),
        torch.where(valid, depth, torch.inf),
        torch.where(valid, matching, torch.inf).clamp(max=1.0),
        valid,
    )

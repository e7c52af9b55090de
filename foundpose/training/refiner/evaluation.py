"""How right perturbed poses are before and after a refiner."""

import torch
from torch import Tensor

from foundpose.geometry import pose_deviation
from foundpose.losses import point_matching_error
from foundpose.onboarding import Progress
from foundpose.refinement import RenderAndCompareRefiner
from foundpose.training.errors import PoseErrors, join_errors
from foundpose.training.refiner.data import RefinerBatch, RefinerPictures


@torch.no_grad()  # a measurement
def evaluate_refiner(
    refiner: RenderAndCompareRefiner,
    pictures: RefinerPictures,
    batch_size: int = 32,
    progress: Progress | None = None,
) -> tuple[PoseErrors, PoseErrors]:
    """Errors of the pictures' perturbed poses, before and after refining them, at the objects' centres.

    Where the refiner gives no pose, the errors after are those before.

    Args:
        refiner: on any device.
        pictures: one perturbation of each is taken.
        batch_size: pictures at a time.
        progress: is told of every batch.
    """
    device = next((p.device for p in refiner.parameters()), torch.device("cpu"))
    before, after = [], []
    for start in range(0, len(pictures), batch_size):
        batch = pictures.__getitems__(range(start, min(start + batch_size, len(pictures))))
        count = len(batch.T_start)
        found = refiner.refine(batch.T_start.to(device), batch.pictured.to(device))
        centre = pictures.centre[batch.pictured.mesh_index]
        before.append(_errors(batch.T_start, torch.ones(count, dtype=torch.bool), batch, centre))
        after.append(_errors(found.T_camera_from_model.cpu(), found.valid.cpu(), batch, centre))
        if progress is not None:
            progress("poses", start + count, len(pictures))
    return join_errors(before), join_errors(after)


def _errors(T: Tensor, valid: Tensor, batch: RefinerBatch, centre: Tensor) -> PoseErrors:
    matching = point_matching_error(T, batch.T_true, batch.surface, diameter=batch.diameter, norm="l2")
    deviation = pose_deviation(T, batch.T_true, batch.diameter, centre)
    return PoseErrors(*deviation, matching.clamp(max=1.0), valid)

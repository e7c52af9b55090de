"""Training of a learned refiner by the disentangled distance of the object's points."""

import math
from typing import NamedTuple

import pytorch_lightning as pl
import torch
from torch import Tensor

from foundpose.losses import point_matching_error
from foundpose.refinement import RenderAndCompareRefiner, Views, apply_update, update_between
from foundpose.training.base import adam
from foundpose.training.refiner.data import RefinerBatch


class RefinerLoss(NamedTuple):
    """Loss of a batch.

    Attributes:
        loss: scalar, mean over poses that can be rendered, summed over the iterations.
        before: (B,) mean distance of the object's points at the initial poses, in diameters.
        after: (B,) the same after the last iteration.
        valid: (B,) bool, rendered in every iteration.
    """

    loss: Tensor
    before: Tensor
    after: Tensor
    valid: Tensor


def disentangled_error(
    views: Views, update: Tensor, T_true: Tensor, surface: Tensor, diameter: Tensor, valid: Tensor
) -> Tensor:
    """Point-matching errors of the parts of an update, each combined with the truth of the others.

    So a wrong depth does not teach the rotation to make up for it.

    Args:
        views: B poses that were updated, in the network's virtual cameras.
        update: (B, 9) predicted updates.
        T_true: (B, 4, 4) true ``T_camera_from_model``, mesh units.
        surface: (B, P, 3) points of the objects, mesh units.
        diameter: (B,) mesh units.
        valid: (B,) bool.

    Returns:
        (B, 3) mean l1 distances in diameters: of the image shift, the depth and the rotation. Zero where not valid.

    Differentiable w.r.t. ``update``.

    Source: Labbé et al., "CosyPose", ECCV 2020.
    """
    T_true = views.T_view_from_camera @ T_true
    truth = update_between(views.T_view_from_model, T_true, views.K, views.centre)
    parts = []
    for part in (slice(0, 2), slice(2, 3), slice(3, 9)):
        mixed = truth.clone()
        mixed[:, part] = update[:, part]
        T = apply_update(views.T_view_from_model, mixed, views.K, views.centre)
        parts.append(point_matching_error(T, T_true, surface, diameter=diameter, valid=valid, norm="l1"))
    return torch.stack(parts, dim=-1)


class RefinerTraining(pl.LightningModule):
    """Trains a refiner's network; poses between iterations are detached, as they are when refining.

    A score that the network may give is not trained.

    Args:
        refiner: what is trained.
        iterations: updates for each picture, each with its loss.
        learning_rate: of AdamW at the start; falls to zero over the epochs of the trainer as a cosine.
        weight_decay: of matrices (decoupled).
        depth_weight: of the depth's part of the loss. A depth is easily wrong by more than a rotation can be, and
            would drown it.

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(
        self,
        refiner: RenderAndCompareRefiner,
        iterations: int = 2,
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-3,
        depth_weight: float = 0.3,
    ) -> None:
        super().__init__()
        if iterations < 1 or not learning_rate > 0 or weight_decay < 0 or not depth_weight > 0:
            raise ValueError(
                "iterations must be at least 1, learning_rate and depth_weight positive and weight_decay not "
                f"negative, got {iterations}, {learning_rate}, {depth_weight} and {weight_decay}"
            )
        self.refiner = refiner
        self.iterations = iterations
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.depth_weight = depth_weight

    def batch_loss(self, batch: RefinerBatch) -> RefinerLoss:
        """Loss of B pictures; differentiable w.r.t. the network's parameters."""
        refiner, T = self.refiner, batch.T_start
        weights = T.new_tensor([1.0, self.depth_weight, 1.0])
        valid = torch.ones_like(batch.pictured.mesh_index, dtype=torch.bool)
        total = T.new_zeros(())
        for _ in range(self.iterations):
            views = refiner.look(T, batch.pictured)
            update, _ = refiner.predict(views)
            valid = valid & views.valid
            parts = disentangled_error(views, update, batch.T_true, batch.surface, batch.diameter, valid)
            total = total + (parts @ weights).sum() / valid.sum().clamp(min=1)
            T = refiner.move(views, update.detach())
        before, after = (
            point_matching_error(
                T, batch.T_true, batch.surface, diameter=batch.diameter, valid=valid, norm="l2"
            )
            for T in (batch.T_start, T)
        )
        return RefinerLoss(total, before, after, valid)

    def training_step(self, batch: RefinerBatch, batch_idx: int) -> Tensor:
        """Loss of a batch; logged with the share of the points' distance that is left."""
        result = self.batch_loss(batch)
        self._log("train", result)
        return result.loss

    def validation_step(self, batch: RefinerBatch, batch_idx: int) -> None:
        """Log the same of other objects."""
        self._log("val", self.batch_loss(batch))

    def _log(self, stage: str, result: RefinerLoss) -> None:
        size = len(result.valid)
        left = result.after.detach().sum() / result.before.sum().clamp(min=1e-9)
        for name, value in (("loss", result.loss.detach()), ("error_left", left)):
            self.log(f"{stage}/{name}", value, prog_bar=True, on_step=False, on_epoch=True, batch_size=size)

    def configure_optimizers(self) -> pl.utilities.types.OptimizerLRScheduler:
        """AdamW, decay for matrices only; the learning rate follows a cosine over the trainer's epochs."""
        optimizer = adam(self, self.learning_rate, self.weight_decay)
        # Lightning's guess of the number of steps; of the epochs set now, so a resumed run may have more.
        steps = max(1, int(self.trainer.estimated_stepping_batches))

        def rate(step: int) -> float:
            warm = min(1.0, (step + 1) / (0.03 * steps + 1))
            return warm * 0.5 * (1.0 + math.cos(math.pi * min(step / steps, 1.0)))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

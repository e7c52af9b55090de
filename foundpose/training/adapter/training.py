"""Training of an adapter by the error of the poses that its descriptors lead to."""

from typing import NamedTuple

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from foundpose.features import ResidualAdapter
from foundpose.losses import GeodesicRotationLoss, PointMatchingLoss, ProjectionLoss
from foundpose.matching import SoftPatchMatcher
from foundpose.pnp import LevenbergMarquardtPnp, PnpProblem, RansacPnp
from foundpose.representation import TemplatePatches
from foundpose.retrieval import QueryPatches
from foundpose.training.adapter.pairs import PairBatch
from foundpose.training.base import adam


class PairPoses(NamedTuple):
    """Poses from pairs.

    Attributes:
        T_crop_from_model: (B, 4, 4), mesh units.
        valid: (B,) bool, the pose is an optimum with a gradient.
    """

    T_crop_from_model: Tensor
    valid: Tensor


class PairLoss(NamedTuple):
    """Loss of a batch of pairs.

    Attributes:
        loss: scalar, mean over the valid pairs.
        error: (B,) errors of the poses, in the loss's unit; 0 where not valid.
        valid: (B,) bool.
    """

    loss: Tensor
    error: Tensor
    valid: Tensor


class AdapterTraining(pl.LightningModule):
    """Trains an adapter end to end: adapted descriptors, soft matching, PnP with implicit gradients, pose error.

    Nothing tells the adapter which patches belong together; it only hears how far off the pose is, for instance how
    far the model's points land from where they should. A pair's loss is ``log(1 + error / error_scale)``, so that a
    hopeless pair pulls no harder than others. The pairs' symmetries count.

    Args:
        adapter: what is trained, on both sides of a pair.
        matcher: matches adapted descriptors; its temperature is trained along if it is learnable.
        pnp: estimates poses: :class:`LevenbergMarquardtPnp` starts at the true pose, :class:`RansacPnp` finds its own
            start. The less robust its loss, the more matches have a gradient. Pairs whose pose is no regular optimum,
            and so has no gradient, do not count.
        loss: error of a pose, ``reduction="none"``: in diameters for :class:`PointMatchingLoss` (the default, with
            ``norm="l2"``), in pixels of the crop for :class:`ProjectionLoss`, in radians for
            :class:`GeodesicRotationLoss`. Any other module is called as the first of these is.
        learning_rate: of Adam.
        weight_decay: of the adapter's matrices (decoupled).
        error_scale: error beyond which a pair's pull wanes, in the loss's unit.

    Raises:
        ValueError: a setting out of range, or a loss that is reduced.
    """

    def __init__(
        self,
        adapter: ResidualAdapter,
        matcher: SoftPatchMatcher,
        pnp: LevenbergMarquardtPnp | RansacPnp,
        loss: nn.Module | None = None,
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        error_scale: float = 0.05,
    ) -> None:
        super().__init__()
        if not learning_rate > 0 or not error_scale > 0 or weight_decay < 0:
            raise ValueError(
                "learning_rate and error_scale must be positive and weight_decay not negative, got "
                f"{learning_rate}, {error_scale} and {weight_decay}"
            )
        loss = PointMatchingLoss("l2") if loss is None else loss
        if getattr(loss, "reduction", "none") != "none":
            raise ValueError(
                f'loss must have reduction="none" (one error for each pair), got {loss.reduction!r}'
            )
        self.adapter = adapter
        self.matcher = matcher
        self.pnp = pnp
        self.loss = loss
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.error_scale = error_scale

    def forward(self, batch: PairBatch) -> PairPoses:
        """Estimate the poses of B pairs.

        Differentiable w.r.t. the parameters of adapter and matcher, and the batch's descriptors and points, through
        the optimum of PnP.
        """
        query = QueryPatches(self.adapter(batch.query_descriptors), batch.query_pixels, batch.query_valid)
        template = TemplatePatches(
            self.adapter(batch.template_descriptors).unsqueeze(1),
            batch.template_points.unsqueeze(1),
            batch.template_points.new_zeros(*batch.template_valid.shape, 2).unsqueeze(1),  # not looked at
            batch.template_valid.unsqueeze(1),
        )
        matches = self.matcher(query, template)
        points, weight, valid = (x.squeeze(1) for x in (matches.points_model, matches.weight, matches.valid))
        problem = PnpProblem(batch.query_pixels, points, batch.K_crop, valid, weight)
        if isinstance(self.pnp, RansacPnp):
            found = self.pnp(problem)
            return PairPoses(found.T_camera_from_model, found.success & found.regular)
        optimum = self.pnp(batch.T_crop_from_model, problem)
        # The implicit gradient is that of an optimum, so there has to be one.
        valid = optimum.converged & optimum.regular & ~optimum.failed
        return PairPoses(optimum.T_camera_from_model, valid)

    def pose_errors(self, poses: PairPoses, batch: PairBatch) -> Tensor:
        """Errors (B,) of the poses of B pairs, in the loss's unit; 0 where not valid."""
        T, T_true = poses.T_crop_from_model, batch.T_crop_from_model
        symmetries, valid = batch.symmetries, poses.valid
        if isinstance(self.loss, GeodesicRotationLoss):
            return self.loss(T, T_true, symmetries=symmetries, valid=valid)
        if isinstance(self.loss, ProjectionLoss):
            return self.loss(T, T_true, batch.surface, batch.K_crop, symmetries=symmetries, valid=valid)
        return self.loss(
            T, T_true, batch.surface, symmetries=symmetries, diameter=batch.diameter, valid=valid
        )

    def pair_loss(self, batch: PairBatch) -> PairLoss:
        """Loss of B pairs; differentiable as :meth:`forward` is."""
        poses = self(batch)
        error = self.pose_errors(poses, batch)
        # Not valid: an error of zero, which adds nothing.
        loss = torch.log1p(error / self.error_scale).sum() / poses.valid.sum().clamp(min=1)
        return PairLoss(loss, error, poses.valid)

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        """Loss of a batch; logged with the median error and the temperature."""
        result = self.pair_loss(batch)
        self._log("train", result)
        self.log("temperature", self.matcher.temperature.detach(), prog_bar=True)
        return result.loss

    def validation_step(self, batch: PairBatch, batch_idx: int) -> None:
        """Log the same of pairs of other objects."""
        self._log("val", self.pair_loss(batch))

    def _log(self, stage: str, result: PairLoss) -> None:
        def log(name: str, value: Tensor, size: int) -> None:
            bar = name == "loss"
            self.log(f"{stage}/{name}", value, prog_bar=bar, on_step=False, on_epoch=True, batch_size=size)

        log("valid", result.valid.float().mean(), len(result.valid))
        count = int(result.valid.sum())
        # The loss and the errors are those of the valid pairs; without any there is nothing to tell.
        if count > 0:
            log("loss", result.loss.detach(), count)
            error = torch.where(result.valid, result.error.detach(), torch.nan)
            log("median_error", error.nanmedian(), count)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam; decay for matrices only."""
        return adam(self, self.learning_rate, self.weight_decay)

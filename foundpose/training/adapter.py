"""Training of an adapter by the error of the poses that its descriptors lead to."""

from typing import NamedTuple

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from foundpose.features import ResidualAdapter
from foundpose.losses import point_matching_error
from foundpose.matching import SoftPatchMatcher
from foundpose.pnp import GaussNewtonPnp, RansacPnp
from foundpose.training.pairs import PairBatch


class PairPoses(NamedTuple):
    """Poses from pairs.

    Attributes:
        T_crop_from_model: (B, 4, 4), mesh units.
        valid: (B,) bool.
    """

    T_crop_from_model: Tensor
    valid: Tensor


class PairLoss(NamedTuple):
    """Loss of a batch of pairs.

    Attributes:
        loss: scalar, mean over the valid pairs.
        error: (B,) point-matching errors in diameters; 0 where not valid.
        valid: (B,) bool.
    """

    loss: Tensor
    error: Tensor
    valid: Tensor


class AdapterTraining(pl.LightningModule):
    """Trains an adapter end to end: adapted descriptors, soft matching, PnP with implicit gradients, pose error.

    Nothing tells the adapter which patches belong together; it only hears how far the model's points land from
    where they should. A pair's loss is ``log(1 + error / error_scale)``, so that a hopeless pair pulls no harder than
    others.

    Args:
        adapter: what is trained, on both sides of a pair.
        matcher: matches adapted descriptors; its temperature is trained along if it is learnable.
        pnp: estimates poses: :class:`GaussNewtonPnp` starts at the true pose, :class:`RansacPnp` finds its own start.
            The less robust its loss, the more matches have a gradient. Pairs without a converged pose do not count.
        learning_rate: of Adam.
        weight_decay: of the adapter's matrices (decoupled).
        error_scale: error in diameters beyond which a pair's pull wanes.

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(
        self,
        adapter: ResidualAdapter,
        matcher: SoftPatchMatcher,
        pnp: GaussNewtonPnp | RansacPnp,
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
        self.adapter = adapter
        self.matcher = matcher
        self.pnp = pnp
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.error_scale = error_scale

    def forward(self, batch: PairBatch) -> PairPoses:
        """Estimate the poses of B pairs.

        Differentiable w.r.t. the parameters of adapter and matcher, and the batch's descriptors and points, through
        the optimum of PnP.
        """
        matches = self.matcher(
            self.adapter(batch.query_descriptors),
            batch.query_valid,
            self.adapter(batch.template_descriptors).unsqueeze(1),
            batch.template_valid.unsqueeze(1),
            batch.query_pixels,
            batch.template_points.unsqueeze(1),
        )
        points, weight, valid = (x.squeeze(1) for x in (matches.points_model, matches.weight, matches.valid))
        if isinstance(self.pnp, RansacPnp):
            found = self.pnp(batch.query_pixels, points, batch.K_crop, valid, weight)
            return PairPoses(found.T_camera_from_model, found.success)
        optimum = self.pnp(batch.T_crop_from_model, batch.query_pixels, points, batch.K_crop, weight)
        # The implicit gradient is that of an optimum, so there has to be one.
        return PairPoses(optimum.T_camera_from_model, optimum.converged & ~optimum.failed)

    def pair_loss(self, batch: PairBatch) -> PairLoss:
        """Loss of B pairs; differentiable as :meth:`forward` is."""
        T, valid = self(batch)
        error = point_matching_error(
            T, batch.T_crop_from_model, batch.surface, diameter=batch.diameter, valid=valid, norm="l2"
        )
        # Not valid: an error of zero, which adds nothing.
        loss = torch.log1p(error / self.error_scale).sum() / valid.sum().clamp(min=1)
        return PairLoss(loss, error, valid)

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
        size = len(result.valid)
        error = torch.where(result.valid, result.error.detach(), torch.inf)
        self.log(
            f"{stage}/loss",
            result.loss.detach(),
            prog_bar=True,
            on_step=False,
            on_epoch=True,
            batch_size=size,
        )
        for name, value in (("median_error", error.median()), ("valid", result.valid.float().mean())):
            self.log(f"{stage}/{name}", value, on_step=False, on_epoch=True, batch_size=size)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam; decay for matrices only."""
        groups: dict[bool, list[nn.Parameter]] = {True: [], False: []}
        for parameter in self.parameters():
            if parameter.requires_grad:
                groups[parameter.dim() > 1].append(parameter)
        return torch.optim.AdamW(
            [
                {"params": groups[True], "weight_decay": self.weight_decay},
                {"params": groups[False], "weight_decay": 0.0},
            ],
            lr=self.learning_rate,
        )

"""Progress of Lightning's loops, as of everything else: its own bars write to standard output."""

from typing import Any

import pytorch_lightning as pl

from foundpose.utils.progress import ProgressBars


class LightningProgress(pl.Callback):
    """Shows the first process's batches of training and prediction."""

    def __init__(self) -> None:
        self._bars = ProgressBars()

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """After a step of training."""
        self._show(trainer, f"epoch {trainer.current_epoch}", batch_idx, trainer.num_training_batches)

    def on_predict_batch_end(
        self,
        trainer: pl.Trainer,
        module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """After a batch of predictions."""
        self._show(trainer, "poses, batches", batch_idx, trainer.num_predict_batches[dataloader_idx])

    def _show(self, trainer: pl.Trainer, stage: str, batch_idx: int, total: int | float) -> None:
        if trainer.is_global_zero and total != float("inf"):
            self._bars(stage, batch_idx + 1, int(total))

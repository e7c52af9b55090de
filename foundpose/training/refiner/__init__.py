"""Training of a render-and-compare refiner by the distance of the object's points."""

from foundpose.training.refiner.data import (
    Perturbation,
    PictureSettings,
    RefinerBatch,
    RefinerDataModule,
    RefinerPictures,
)
from foundpose.training.refiner.evaluation import evaluate_refiner
from foundpose.training.refiner.training import RefinerLoss, RefinerTraining, disentangled_error

__all__ = [
    "Perturbation",
    "PictureSettings",
    "RefinerBatch",
    "RefinerDataModule",
    "RefinerLoss",
    "RefinerPictures",
    "RefinerTraining",
    "disentangled_error",
    "evaluate_refiner",
]

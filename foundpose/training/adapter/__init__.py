"""Training of an adapter by the poses that its descriptors lead to."""

from foundpose.training.adapter.data import PairDataModule
from foundpose.training.adapter.evaluation import evaluate_scenes
from foundpose.training.adapter.pairs import PairBatch, PairSettings, PatchPairs, make_pairs
from foundpose.training.adapter.training import AdapterTraining, PairLoss, PairPoses

__all__ = [
    "AdapterTraining",
    "PairBatch",
    "PairDataModule",
    "PairLoss",
    "PairPoses",
    "PairSettings",
    "PatchPairs",
    "evaluate_scenes",
    "make_pairs",
]

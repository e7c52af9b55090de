"""What training through the pipeline needs: rendered views, pairs, Lightning modules and a measure of success.

Imports pytorch_lightning, as only ``foundpose.evaluation`` does besides.
"""

from foundpose.training.adapter.data import PairDataModule
from foundpose.training.adapter.evaluation import evaluate_scenes
from foundpose.training.adapter.pairs import PairBatch, PairSettings, PatchPairs, make_pairs
from foundpose.training.adapter.training import AdapterTraining, PairLoss, PairPoses
from foundpose.training.base import EpochShuffle, RenderedDataModule
from foundpose.training.confidence import ConfidencePictures, collect_evidence
from foundpose.training.errors import PoseErrors, compare, summarize
from foundpose.training.refiner.data import (
    Perturbation,
    PictureSettings,
    RefinerBatch,
    RefinerDataModule,
    RefinerPictures,
)
from foundpose.training.refiner.evaluation import evaluate_refiner
from foundpose.training.refiner.training import RefinerLoss, RefinerTraining, disentangled_error
from foundpose.training.views import (
    TemplateViews,
    TrueCrops,
    nearby_rotations,
    render_crops,
    render_templates,
)

__all__ = [
    "AdapterTraining",
    "ConfidencePictures",
    "EpochShuffle",
    "PairBatch",
    "PairDataModule",
    "PairLoss",
    "PairPoses",
    "PairSettings",
    "PatchPairs",
    "Perturbation",
    "PictureSettings",
    "PoseErrors",
    "RefinerBatch",
    "RefinerDataModule",
    "RefinerLoss",
    "RefinerPictures",
    "RefinerTraining",
    "RenderedDataModule",
    "TemplateViews",
    "TrueCrops",
    "collect_evidence",
    "compare",
    "disentangled_error",
    "evaluate_refiner",
    "evaluate_scenes",
    "make_pairs",
    "nearby_rotations",
    "render_crops",
    "render_templates",
    "summarize",
]

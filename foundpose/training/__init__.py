"""What training through the pipeline needs: rendered views, pairs, Lightning modules and a measure of success.

Imports pytorch_lightning; nothing else in the library does.
"""

from foundpose.training.adapter import AdapterTraining, PairLoss, PairPoses
from foundpose.training.data import EpochShuffle, PairDataModule
from foundpose.training.evaluation import PoseErrors, compare, evaluate_scenes, summarize
from foundpose.training.pairs import PairBatch, PairSettings, PatchPairs, make_pairs
from foundpose.training.views import (
    TemplateViews,
    TrueCrops,
    nearby_rotations,
    render_crops,
    render_templates,
)

__all__ = [
    "AdapterTraining",
    "EpochShuffle",
    "PairBatch",
    "PairDataModule",
    "PairLoss",
    "PairPoses",
    "PairSettings",
    "PatchPairs",
    "PoseErrors",
    "TemplateViews",
    "TrueCrops",
    "compare",
    "evaluate_scenes",
    "make_pairs",
    "nearby_rotations",
    "render_crops",
    "render_templates",
    "summarize",
]

"""The composed method: crop, describe, retrieve, match, solve, choose, refine."""

from foundpose.pipeline.finding import DetectAndEstimate, FoundInstances
from foundpose.pipeline.foundpose import FoundPose
from foundpose.pipeline.hypotheses import HypothesisMaker, MatchAndSolve, TemplateHypotheses
from foundpose.pipeline.query import select_query_patches
from foundpose.pipeline.results import (
    Correspondences,
    Hypothesised,
    PoseEstimates,
    PoseHypotheses,
    PoseStatus,
)
from foundpose.pipeline.verification import HypothesisScorer, InlierScore, PatchVerification

__all__ = [
    "Correspondences",
    "DetectAndEstimate",
    "FoundInstances",
    "FoundPose",
    "HypothesisMaker",
    "HypothesisScorer",
    "Hypothesised",
    "InlierScore",
    "MatchAndSolve",
    "PatchVerification",
    "PoseEstimates",
    "PoseHypotheses",
    "PoseStatus",
    "TemplateHypotheses",
    "select_query_patches",
]

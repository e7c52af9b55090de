"""The composed method: crop, describe, retrieve, match, solve, choose, refine."""

from foundpose.pipeline.calibration import Reliability, fit_confidence, reliability
from foundpose.pipeline.confidence import RIGHT_PIXELS, PoseConfidence, pose_evidence
from foundpose.pipeline.finding import DetectAndEstimate, FoundInstances
from foundpose.pipeline.foundpose import FoundPose
from foundpose.pipeline.hypotheses import HypothesisMaker, MatchAndSolve, TemplateHypotheses
from foundpose.pipeline.query import select_query_patches
from foundpose.pipeline.results import (
    Correspondences,
    Hypothesised,
    PoseEstimates,
    PoseEvidence,
    PoseHypotheses,
    PoseStatus,
)
from foundpose.pipeline.verification import HypothesisScorer, InlierScore, PatchVerification

__all__ = [
    "RIGHT_PIXELS",
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
    "PoseConfidence",
    "PoseEstimates",
    "PoseEvidence",
    "PoseHypotheses",
    "PoseStatus",
    "Reliability",
    "TemplateHypotheses",
    "fit_confidence",
    "pose_evidence",
    "reliability",
    "select_query_patches",
]

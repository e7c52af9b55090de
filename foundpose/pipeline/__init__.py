"""The composed method: crop, describe, retrieve, match, solve, choose, refine."""

from foundpose.pipeline.foundpose import FoundPose
from foundpose.pipeline.results import Correspondences, PoseEstimates, PoseHypotheses, PoseStatus
from foundpose.pipeline.verification import HypothesisScorer, InlierScore, PatchVerification

__all__ = [
    "Correspondences",
    "FoundPose",
    "HypothesisScorer",
    "InlierScore",
    "PatchVerification",
    "PoseEstimates",
    "PoseHypotheses",
    "PoseStatus",
]

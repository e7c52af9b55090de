"""6D pose of unseen objects from one RGB image: FoundPose (ECCV 2024) as differentiable, batched modules."""

from foundpose.config import load
from foundpose.detection import Detector
from foundpose.features import DenseSift, DinoV2, FeatureHook, PatchExtractor, PcaProjection
from foundpose.geometry import PerspectiveCrop, SphereInplane, SuperFibonacci
from foundpose.matching import PatchMatcher, SoftPatchMatcher
from foundpose.onboarding import Onboarder, RepresentationStore
from foundpose.pipeline import (
    DetectAndEstimate,
    FoundInstances,
    FoundPose,
    InlierScore,
    MatchAndSolve,
    PatchVerification,
    PoseEstimates,
    PoseStatus,
    TemplateHypotheses,
)
from foundpose.pnp import (
    LevenbergMarquardtPnp,
    RansacPnp,
    SoftInlierSelection,
    TemplateStart,
    TopTemplatePose,
)
from foundpose.refinement import FeaturemetricRefiner, PoseRefiner, RefinerChain, RenderAndCompareRefiner
from foundpose.rendering import Mesh, PyrenderRenderer, RaycastRenderer, load_mesh
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import (
    ClsRetriever,
    PatchVoteRetriever,
    SoftAssignBow,
    SpatialReranker,
    TemplateRetriever,
    VisualWords,
)

__version__ = "0.1.0"

__all__ = [
    "ClsRetriever",
    "DenseSift",
    "DetectAndEstimate",
    "Detector",
    "DinoV2",
    "FeatureHook",
    "FeaturemetricRefiner",
    "FoundInstances",
    "FoundPose",
    "InlierScore",
    "LevenbergMarquardtPnp",
    "MatchAndSolve",
    "Mesh",
    "ObjectRepresentation",
    "Onboarder",
    "PatchExtractor",
    "PatchMatcher",
    "PatchVerification",
    "PatchVoteRetriever",
    "PcaProjection",
    "PerspectiveCrop",
    "PoseEstimates",
    "PoseRefiner",
    "PoseStatus",
    "PyrenderRenderer",
    "RansacPnp",
    "RaycastRenderer",
    "RefinerChain",
    "RenderAndCompareRefiner",
    "RepresentationStore",
    "SoftAssignBow",
    "SoftInlierSelection",
    "SoftPatchMatcher",
    "SpatialReranker",
    "SphereInplane",
    "SuperFibonacci",
    "TemplateHypotheses",
    "TemplateRetriever",
    "TemplateStart",
    "TopTemplatePose",
    "VisualWords",
    "load",
    "load_mesh",
]

"""Pose refinement: featuremetric alignment, the refiner contract, learned refiners."""

from foundpose.refinement.base import Observation, PoseProposals, PoseRefiner
from foundpose.refinement.cost import AlignmentProblem, FeatureMaps
from foundpose.refinement.featuremetric import Alignment, FeaturemetricAlignment
from foundpose.refinement.interpolation import sample_features
from foundpose.refinement.megapose import MegaPoseNetwork, MegaPoseRefiner, MegaPoseScorer
from foundpose.refinement.network import UpdateNetwork
from foundpose.refinement.pose_update import apply_update, rotation_from_6d, rotation_to_6d, update_between
from foundpose.refinement.refiners import FeaturemetricRefiner, RefinerChain, alignment_problem
from foundpose.refinement.render_and_compare import PicturedObjects, RenderAndCompareRefiner, Views

__all__ = [
    "Alignment",
    "AlignmentProblem",
    "FeatureMaps",
    "FeaturemetricAlignment",
    "FeaturemetricRefiner",
    "MegaPoseNetwork",
    "MegaPoseRefiner",
    "MegaPoseScorer",
    "Observation",
    "PicturedObjects",
    "PoseProposals",
    "PoseRefiner",
    "RefinerChain",
    "RenderAndCompareRefiner",
    "UpdateNetwork",
    "Views",
    "alignment_problem",
    "apply_update",
    "rotation_from_6d",
    "rotation_to_6d",
    "sample_features",
    "update_between",
]

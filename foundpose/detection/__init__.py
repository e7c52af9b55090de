"""Objects found in pictures, without masks: proposals, scored against templates."""

from foundpose.detection.dense import DensePatches, DescriptorMap
from foundpose.detection.detector import Detections, Detector
from foundpose.detection.given import FileProposer
from foundpose.detection.proposals import (
    Pictures,
    Proposals,
    Proposer,
    mask_overlaps,
    pad_proposals,
    proposals_from_boxes,
    suppress,
)
from foundpose.detection.region_tree import RegionTree, region_tree
from foundpose.detection.regions import RegionProposer
from foundpose.detection.sam import SamProposer
from foundpose.detection.scoring import CropScorer, MeanDescriptorScorer, ProposalScorer

__all__ = [
    "CropScorer",
    "DensePatches",
    "DescriptorMap",
    "Detections",
    "Detector",
    "FileProposer",
    "MeanDescriptorScorer",
    "Pictures",
    "ProposalScorer",
    "Proposals",
    "Proposer",
    "RegionProposer",
    "RegionTree",
    "SamProposer",
    "mask_overlaps",
    "pad_proposals",
    "proposals_from_boxes",
    "region_tree",
    "suppress",
]

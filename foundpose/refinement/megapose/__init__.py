"""MegaPose's networks and what they see."""

from foundpose.refinement.megapose.geometry import (
    crop_boxes,
    crop_intrinsics,
    front_views,
    normal_colors,
    sample_boxes,
)
from foundpose.refinement.megapose.network import MegaPoseNetwork
from foundpose.refinement.megapose.refiner import MegaPoseRefiner, MegaPoseScorer

__all__ = [
    "MegaPoseNetwork",
    "MegaPoseRefiner",
    "MegaPoseScorer",
    "crop_boxes",
    "crop_intrinsics",
    "front_views",
    "normal_colors",
    "sample_boxes",
]

"""MegaPose's networks and what they see."""

from foundpose.refinement.megapose.geometry import (
    crop_boxes,
    crop_intrinsics,
    front_views,
    normal_colors,
    sample_boxes,
)
from foundpose.refinement.megapose.network import MegaPoseNetwork

__all__ = [
    "MegaPoseNetwork",
    "crop_boxes",
    "crop_intrinsics",
    "front_views",
    "normal_colors",
    "sample_boxes",
]

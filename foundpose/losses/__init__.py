"""Losses on poses, with the object's symmetries: in 3D, in the image, and of the rotation alone."""

from foundpose.losses.points import PointMatchingLoss, point_matching_error
from foundpose.losses.projection import ProjectionLoss, projection_error
from foundpose.losses.reduction import Norm, Reduction
from foundpose.losses.rotation import GeodesicRotationLoss, geodesic_rotation_error

__all__ = [
    "GeodesicRotationLoss",
    "Norm",
    "PointMatchingLoss",
    "ProjectionLoss",
    "Reduction",
    "geodesic_rotation_error",
    "point_matching_error",
    "projection_error",
]

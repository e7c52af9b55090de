"""Cameras, crops, rotations and rigid transformations."""

from foundpose.geometry.boxes import boxes_from_masks, boxes_from_points, boxes_from_xywh, masks_from_boxes
from foundpose.geometry.cameras import (
    axis_rotation_to_ray,
    camera_on_boxes,
    intrinsics_matrix,
    pixel_grid,
    pixel_rays,
    project_points,
    resize_intrinsics,
    shift_intrinsics,
    unproject_pixels,
)
from foundpose.geometry.crop import Crops, PerspectiveCrop
from foundpose.geometry.deviation import PoseDeviation, perturbed_poses, pose_deviation
from foundpose.geometry.intrinsics import Camera, CameraError, check_camera, read_camera
from foundpose.geometry.masks import grow_masks
from foundpose.geometry.patch_grid import PatchGrid
from foundpose.geometry.symmetries import (
    Symmetries,
    axis_rotation,
    discretise,
    nearest_axis_angles,
    no_symmetries,
    stack_symmetries,
    symmetries_from_models_info,
)
from foundpose.geometry.transforms import (
    invert_transform,
    make_transform,
    project_to_rotation,
    rotation_angle,
    se3_exp,
    transform_points,
)
from foundpose.geometry.viewpoints import (
    SphereInplane,
    SuperFibonacci,
    sphere_inplane_rotations,
    super_fibonacci_rotations,
)

__all__ = [
    "Camera",
    "CameraError",
    "Crops",
    "PatchGrid",
    "PerspectiveCrop",
    "PoseDeviation",
    "SphereInplane",
    "SuperFibonacci",
    "Symmetries",
    "axis_rotation",
    "axis_rotation_to_ray",
    "boxes_from_masks",
    "boxes_from_points",
    "boxes_from_xywh",
    "camera_on_boxes",
    "check_camera",
    "discretise",
    "grow_masks",
    "intrinsics_matrix",
    "invert_transform",
    "make_transform",
    "masks_from_boxes",
    "nearest_axis_angles",
    "no_symmetries",
    "perturbed_poses",
    "pixel_grid",
    "pixel_rays",
    "pose_deviation",
    "project_points",
    "project_to_rotation",
    "read_camera",
    "resize_intrinsics",
    "rotation_angle",
    "se3_exp",
    "shift_intrinsics",
    "sphere_inplane_rotations",
    "stack_symmetries",
    "super_fibonacci_rotations",
    "symmetries_from_models_info",
    "transform_points",
    "unproject_pixels",
]

"""Files of the BOP benchmark: datasets, detections and results."""

from foundpose.bop.dataset import BopDataset
from foundpose.bop.detection_scores import DetectionScores, detection_scores
from foundpose.bop.files import BopError, read_json
from foundpose.bop.instances import Instance, detected_instances, ground_truth_instances
from foundpose.bop.masks import largest_component, plausible_mask, read_mask
from foundpose.bop.precision import PosePrecision, score_pose_detections
from foundpose.bop.results import (
    PoseResult,
    best_of_targets,
    check_times,
    read_results,
    result_file_name,
    share_image_times,
    write_results,
)
from foundpose.bop.scenes import Annotation
from foundpose.bop.scores import Scores
from foundpose.bop.scoring import check_functions, score_results
from foundpose.bop.segmentation import decode_segmentation, encode_segmentation
from foundpose.bop.targets import Target
from foundpose.utils.pictures import PictureError, read_depth, read_image

__all__ = [
    "Annotation",
    "BopDataset",
    "BopError",
    "DetectionScores",
    "Instance",
    "PictureError",
    "PosePrecision",
    "PoseResult",
    "Scores",
    "Target",
    "best_of_targets",
    "check_functions",
    "check_times",
    "decode_segmentation",
    "detected_instances",
    "detection_scores",
    "encode_segmentation",
    "ground_truth_instances",
    "largest_component",
    "plausible_mask",
    "read_depth",
    "read_image",
    "read_json",
    "read_mask",
    "read_results",
    "result_file_name",
    "score_pose_detections",
    "score_results",
    "share_image_times",
    "write_results",
]

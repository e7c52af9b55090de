"""Files of the BOP benchmark: datasets, detections and results."""

from foundpose.bop.dataset import Annotation, BopDataset, Target
from foundpose.bop.files import BopError, read_image, read_mask
from foundpose.bop.instances import Instance, decode_rle, detected_instances, ground_truth_instances
from foundpose.bop.results import PoseResult, read_results, write_results

__all__ = [
    "Annotation",
    "BopDataset",
    "BopError",
    "Instance",
    "PoseResult",
    "Target",
    "decode_rle",
    "detected_instances",
    "ground_truth_instances",
    "read_image",
    "read_mask",
    "read_results",
    "write_results",
]

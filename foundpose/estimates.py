"""What the pipeline returns."""

from enum import IntEnum
from typing import NamedTuple

from torch import Tensor

from foundpose.geometry import Crops
from foundpose.pnp import PnpStatus, PoseCandidates
from foundpose.refinement.base import RefinedPoses
from foundpose.retrieval import QueryPatches, RetrievedTemplates


class PoseStatus(IntEnum):
    """Why a crop has no pose. The codes of :class:`PnpStatus` keep their values."""

    OK = PnpStatus.OK
    TOO_FEW_CORRESPONDENCES = PnpStatus.TOO_FEW_CORRESPONDENCES
    DEGENERATE = PnpStatus.DEGENERATE
    BEHIND_CAMERA = PnpStatus.BEHIND_CAMERA
    TOO_FEW_INLIERS = PnpStatus.TOO_FEW_INLIERS
    UNUSABLE_MASK = 100
    NO_PATCHES = 101


class Correspondences(NamedTuple):
    """2D-3D correspondences of B crops with h retrieved templates each.

    Attributes:
        points_image: (B, P, 2) patch centres in the crop, pixels.
        points_model: (B, h, P, 3) matched points, mesh units.
        pixels_template: (B, h, P, 2) centres of the matched template patches, pixels of the template.
        distance: (B, h, P) descriptor distances, +inf where not valid.
        weight: (B, h, P) confidences in (0, 1], 0 where not valid.
        valid: (B, h, P) bool.
    """

    points_image: Tensor
    points_model: Tensor
    pixels_template: Tensor
    distance: Tensor
    weight: Tensor
    valid: Tensor


class PoseHypotheses(NamedTuple):
    """One pose for each crop and retrieved template.

    Attributes:
        T_crop_from_model: (B, h, 4, 4), mesh units.
        inliers: (B, h, P) bool.
        num_inliers: (B, h).
        status: (B, h) codes of :class:`PoseStatus`.
    """

    T_crop_from_model: Tensor
    inliers: Tensor
    num_inliers: Tensor
    status: Tensor


class PoseEstimates(NamedTuple):
    """Poses of a batch of crops, and what they were made from.

    Attributes:
        T_camera_from_model: (B, 4, 4), mesh units; finite but meaningless where not valid.
        score: (B,) confidence: the share of the crop's patches that are inliers, in [0, 1], or with a refiner the
            refiner's score (0 for a pose that could not be refined and is returned as it was).
        num_inliers: (B,) inlier correspondences of the chosen hypothesis, the quality by which the best of h is
            chosen (with a refiner of several: chosen by its score).
        valid: (B,) bool, a pose with at least the fewest inliers that the PnP stage asks for. It is no confidence:
            noise can reach that many by chance. Judge by ``score``.
        status: (B,) codes of :class:`PoseStatus`.
        best: (B,) which hypothesis was chosen.
        T_coarse: (B, 4, 4) its pose in the camera's frame before refinement; without a refiner the final one.
        crops: the perspective crops.
        query: the crops' patches.
        templates: the retrieved templates.
        correspondences: the matches.
        hypotheses: the poses of all retrieved templates.
        candidates: with a soft selection in the PnP stage, the hypotheses of all templates and samples with the
            probability of choosing each (``T_camera_from_model`` (B, h · J, 4, 4)); None without.
        refined: what the refiner made of the hypotheses that it was given, in the crop's frame; None without.
    """

    T_camera_from_model: Tensor
    score: Tensor
    num_inliers: Tensor
    valid: Tensor
    status: Tensor
    best: Tensor
    T_coarse: Tensor
    crops: Crops
    query: QueryPatches
    templates: RetrievedTemplates
    correspondences: Correspondences
    hypotheses: PoseHypotheses
    candidates: PoseCandidates | None = None
    refined: RefinedPoses | None = None

"""The contract of pose refiners."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor, nn

from foundpose.features import PatchFeatures
from foundpose.geometry import Crops, PatchGrid
from foundpose.rendering import Mesh
from foundpose.representation import ObjectGroups
from foundpose.retrieval import QueryPatches


class Observation(NamedTuple):
    """What is known of B crops before anything is said of poses.

    Attributes:
        crops: the perspective crops.
        features: their raw patch descriptors (B, C, h, w).
        grid: where these patches lie.
        query: the patches that count, with the descriptors of each crop's object.
        groups: the objects, and which crop shows which.
        images: (N, 3, H, W) the pictures that the crops were cut from.
        K: (N, 3, 3) their intrinsics.
        image_index: (B,) the picture of each crop.
        meshes: of the objects, in the order of ``groups.objects``; None where the caller gave none.
    """

    crops: Crops
    features: PatchFeatures
    grid: PatchGrid
    query: QueryPatches
    groups: ObjectGroups
    images: Tensor
    K: Tensor
    image_index: Tensor
    meshes: Sequence[Mesh] | None = None


class PoseProposals(NamedTuple):
    """Poses of B crops, n for each.

    Attributes:
        T_crop_from_model: (B, n, 4, 4), mesh units.
        score: (B, n), the larger the better; poses of one crop are compared by it.
        valid: (B, n) bool; poses that are not valid are finite but mean nothing.
        template_index: (B, n) the template that each pose comes from, int64.
    """

    T_crop_from_model: Tensor
    score: Tensor
    valid: Tensor
    template_index: Tensor


class PoseRefiner(nn.Module, ABC):
    """Improves poses. Any subclass can stand in :class:`foundpose.FoundPose`'s ``refiner``.

    A refiner gives each pose the same answer whatever other poses and crops are refined with it, returns poses that
    it cannot improve as they came and not valid, and never raises for a single bad pose.
    """

    @abstractmethod
    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        """Refine poses; the docstring says what the result is differentiable with respect to."""

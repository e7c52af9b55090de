"""What the pipeline returns."""

from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from foundpose.geometry import Crops
from foundpose.pnp import PnpStatus, PoseCandidates
from foundpose.refinement.base import Observation, PoseProposals
from foundpose.retrieval import QueryPatches, RetrievedTemplates

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image


class PoseStatus(IntEnum):
    """Why a crop has no pose. The codes of :class:`PnpStatus` keep their values.

    UNLIKELY: there is a pose, but :meth:`PoseEstimates.withhold` holds it back.
    """

    OK = PnpStatus.OK
    TOO_FEW_CORRESPONDENCES = PnpStatus.TOO_FEW_CORRESPONDENCES
    DEGENERATE = PnpStatus.DEGENERATE
    BEHIND_CAMERA = PnpStatus.BEHIND_CAMERA
    TOO_FEW_INLIERS = PnpStatus.TOO_FEW_INLIERS
    UNUSABLE_MASK = 100
    NO_PATCHES = 101
    NO_TEMPLATE = 102
    UNLIKELY = 103


class Correspondences(NamedTuple):
    """2D-3D correspondences of B crops with h retrieved templates each.

    Attributes:
        points_image: (B, P, 2) patch centres in the crop, pixels.
        points_model: (B, h, P, 3) matched points, mesh units.
        pixels_template: (B, h, P, 2) centres of the matched template patches, pixels of the template.
        distance: (B, h, P) descriptor distances, +inf where not valid.
        weight: (B, h, P) confidences in (0, 1], 0 where not valid.
        valid: (B, h, P) bool.
        priority: (B, h, P) order in which matches are trusted, −inf where not valid.
    """

    points_image: Tensor
    points_model: Tensor
    pixels_template: Tensor
    distance: Tensor
    weight: Tensor
    valid: Tensor
    priority: Tensor


class PoseHypotheses(NamedTuple):
    """One pose for each crop and retrieved template.

    Attributes:
        T_crop_from_model: (B, h, 4, 4), mesh units.
        inliers: (B, h, P) bool.
        num_inliers: (B, h); 0 without correspondences.
        status: (B, h) codes of :class:`PoseStatus`.
        score: (B, h) by the pipeline's scorer (:class:`~foundpose.pipeline.verification.InlierScore`: the share of
            the crop's patches that are inliers); for poses of templates the similarity of the template. The larger
            the better; means nothing where the status is not OK.
    """

    T_crop_from_model: Tensor
    inliers: Tensor
    num_inliers: Tensor
    status: Tensor
    score: Tensor


class Hypothesised(NamedTuple):
    """Pose hypotheses and what they were made from.

    Attributes:
        hypotheses: one for each crop and retrieved template.
        correspondences: the matches; None where nothing was matched.
        candidates: what a soft selection in the PnP stage chooses from; None without one.
    """

    hypotheses: PoseHypotheses
    correspondences: Correspondences | None = None
    candidates: PoseCandidates | None = None


class PoseEvidence(NamedTuple):
    """What speaks for a pose of each of B crops.

    Attributes:
        inliers: (B,) share of the crop's patches that are inliers.
        similarity: (B,) how much the crop's patches look like those of the nearest template that the pose puts on
            them, see :class:`~foundpose.pipeline.verification.Agreement`.
        coverage: (B,) intersection over union of the patches that the pose covers and the mask's, see there.
        alignment: (B,) mean cosine between the nearest template's patches and the crop's feature map where the pose
            puts them, of those on the mask; one minus it is the featuremetric cost. 0 where there are none.
        consensus: (B,) how much the other hypotheses agree: mean of exp(−d / a tenth of the crop), with d the largest
            distance of the projections of six points around the object; 0 without others.
        size: (B,) log2 of the object's diameter in pixels of an image 640 px wide, over 100 px.
    """

    inliers: Tensor
    similarity: Tensor
    coverage: Tensor
    alignment: Tensor
    consensus: Tensor
    size: Tensor


class PoseEstimates(NamedTuple):
    """Poses of a batch of crops, and what they were made from.

    Attributes:
        T_camera_from_model: (B, 4, 4), mesh units; finite but meaningless where not valid.
        score: (B,) confidence in [0, 1] by the pipeline's scorer, or for poses of templates the similarity of the
            template, at most 1. With a refiner it is that of the refined pose, or the refiner's own score where the
            scorer looks at inliers only (0 for a pose that could not be refined and is returned as it was).
        num_inliers: (B,) inlier correspondences of the chosen hypothesis; 0 for poses of templates.
        valid: (B,) bool, a pose with at least the fewest inliers that the PnP stage asks for. It is no confidence:
            noise can reach that many by chance. Judge by ``score``.
        status: (B,) codes of :class:`PoseStatus`.
        best: (B,) which hypothesis was chosen.
        T_coarse: (B, 4, 4) its pose in the camera's frame before refinement; without a refiner the final one.
        crops: the perspective crops.
        query: the crops' patches.
        templates: the retrieved templates.
        hypotheses: the poses of all retrieved templates.
        correspondences: the matches; None where nothing was matched.
        candidates: with a soft selection in the PnP stage, the hypotheses of all templates and samples with the
            probability of choosing each (``T_camera_from_model`` (B, h · J, 4, 4)); None without.
        refined: what the refiner made of the hypotheses that it was given, in the crop's frame; None without.
        probability: (B,) that the pose is right, by the pipeline's confidence; 0 where it is not valid. None without.
        evidence: what the probability follows from; None without.
        observation: what they were made from, for figures.
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
    hypotheses: PoseHypotheses
    correspondences: Correspondences | None = None
    candidates: PoseCandidates | None = None
    refined: PoseProposals | None = None
    probability: Tensor | None = None
    evidence: PoseEvidence | None = None
    observation: Observation | None = None

    def withhold(self, min_probability: float) -> "PoseEstimates":
        """The same with poses that are less probable marked as not valid, with the status ``UNLIKELY``.

        Without probabilities nothing changes.
        """
        if self.probability is None:
            return self
        unlikely = self.valid & (self.probability.detach() < min_probability)
        status = self.status.masked_fill(unlikely, int(PoseStatus.UNLIKELY))
        return self._replace(valid=self.valid & ~unlikely, status=status)

    def draw(self, index: int, T_true: Tensor | None = None, note: str = "") -> "Image":
        """A picture that tells how a pose came about: :func:`foundpose.pipeline.figure.draw_estimate`."""
        from foundpose.pipeline.figure import draw_estimate

        return draw_estimate(self, index, T_true, note)

    def show(self, index: int, T_true: Tensor | None = None) -> "Figure":
        """The picture of :meth:`draw` as a figure of matplotlib, which notebooks display.

        Args:
            index: which estimate to show.
            T_true: (4, 4) true ``T_camera_from_model``, or None.
        """
        from matplotlib.figure import Figure

        picture = self.draw(index, T_true)
        figure = Figure(figsize=(picture.width / 100, picture.height / 100))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.imshow(picture)
        axes.set_axis_off()
        return figure

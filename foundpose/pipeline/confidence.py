"""How sure one can be of a pose: what speaks for it, and the probability that follows."""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.geometry import project_points, transform_points
from foundpose.pipeline.results import PoseEstimates, PoseEvidence, PoseStatus
from foundpose.pipeline.verification import pose_agreement
from foundpose.refinement import Observation, PoseProposals
from foundpose.refinement.interpolation import sample_features
from foundpose.refinement.refiners import alignment_problem, patches_on_mask
from foundpose.representation import ObjectRepresentation, take_rows

RIGHT_PIXELS = 20.0
"""A pose is right if its MSPD is below so many pixels of an image 640 px wide."""

# Pixels of a crop: patches that the pose puts so near the mask count as on it; the refiner's for photographs.
_MASK_MARGIN = 7.0
# Share of the crop's side by which hypotheses that agree lie apart at most, about.
_CONSENSUS = 0.1


def pose_evidence(estimates: PoseEstimates, observation: Observation) -> PoseEvidence:
    """Collect what speaks for estimated poses.

    Args:
        estimates: the poses.
        observation: what they were made from.

    Differentiable w.r.t. the poses (through ``alignment``, ``consensus`` and ``size``), the crops' features and the
    objects' buffers; ``inliers``, ``similarity`` and ``coverage`` are constants.
    """
    crops, query, groups = observation.crops, observation.query, observation.groups
    T = crops.T_crop_from_camera @ estimates.T_camera_from_model.to(crops.T_crop_from_camera)

    def agreement(obj: ObjectRepresentation, rows: Tensor) -> Tensor:
        with torch.no_grad():
            found = pose_agreement(T[rows, None], take_rows(query, rows), crops.K_crop[rows], obj)
        return torch.cat(found, dim=1)

    similarity, coverage = groups.map(agreement).unbind(1)
    diameter = torch.tensor([obj.info.diameter for obj in groups.objects])[groups.object_index].to(T)
    focal = observation.K[observation.image_index.to(observation.K.device), 0, 0].to(T)
    depth = T[:, :3, 3].norm(dim=1).clamp(min=1e-6)
    pixels = focal * diameter / depth * (640.0 / observation.images.shape[-1])
    return PoseEvidence(
        inliers=estimates.num_inliers / query.valid.sum(dim=1).clamp(min=1),
        similarity=similarity,
        coverage=coverage,
        alignment=_alignment(T, estimates, observation),
        consensus=_consensus(T, diameter, estimates, observation),
        size=torch.log2(pixels / 100.0),
    )


def _alignment(T: Tensor, estimates: PoseEstimates, observation: Observation) -> Tensor:
    template = estimates.templates.index.gather(1, estimates.best[:, None])
    proposals = PoseProposals(T[:, None], estimates.score[:, None], estimates.valid[:, None], template)
    problem = alignment_problem(proposals, observation, num_views=1)
    on_mask = problem.valid & patches_on_mask(T, problem, observation.crops.masks, _MASK_MARGIN)
    pixels, _ = project_points(transform_points(T, problem.points_model), problem.K)
    position = problem.maps.grid.to_map(torch.where(on_mask.unsqueeze(-1), pixels, torch.zeros_like(pixels)))
    seen = sample_features(problem.maps.values, problem.map_index, position)[:, :, 0]
    cosine = F.cosine_similarity(seen, problem.descriptors, dim=-1)
    return (cosine * on_mask).sum(1) / on_mask.sum(1).clamp(min=1)


def _consensus(T: Tensor, diameter: Tensor, estimates: PoseEstimates, observation: Observation) -> Tensor:
    hypotheses, crops = estimates.hypotheses, observation.crops

    def centre(obj: ObjectRepresentation, rows: Tensor) -> Tensor:
        return obj.points_model.mean(dim=0).expand(len(rows), -1)

    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(T)
    points = observation.groups.map(centre).to(T)[:, None] + 0.5 * diameter[:, None, None] * axes  # (B, 6, 3)
    others = hypotheses.status == PoseStatus.OK
    others = others.scatter(1, estimates.best[:, None], False)
    poses = torch.cat([T[:, None], hypotheses.T_crop_from_model.detach().to(T)], dim=1)
    pixels, depth = project_points(transform_points(poses, points[:, None]), crops.K_crop.to(T)[:, None])
    others = others & (depth > 0).all(-1)[:, 1:] & (depth > 0).all(-1)[:, :1]
    pixels = torch.where(
        others[..., None, None], pixels[:, 1:] - pixels[:, :1], torch.ones_like(pixels[:, 1:])
    )
    apart = pixels.norm(dim=-1).amax(dim=-1)
    agree = torch.exp(-apart / (_CONSENSUS * crops.images.shape[-1]))
    return (agree * others).sum(1) / others.sum(1).clamp(min=1)


class PoseConfidence(nn.Module):
    """Probability that a pose is right: that its MSPD is below 20 px of an image 640 px wide.

    A logistic regression on :class:`PoseEvidence`. Its numbers belong to the extractor and the settings that they
    were fitted with, see :func:`foundpose.training.fit_confidence`.

    Args:
        weights: of the evidence by name; what is left out has none.
        bias: added to the weighted sum.

    Raises:
        ValueError: an unknown name.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, weights: Mapping[str, float], bias: float) -> None:
        super().__init__()
        unknown = sorted(set(weights) - set(PoseEvidence._fields))
        if unknown:
            raise ValueError(
                f"weights must be of {', '.join(PoseEvidence._fields)}; got {', '.join(unknown)}"
            )
        values = [float(weights.get(name, 0.0)) for name in PoseEvidence._fields]
        self.register_buffer("weight", torch.tensor(values))
        self.register_buffer("bias", torch.tensor(float(bias)))

    def forward(self, evidence: PoseEvidence) -> Tensor:
        """Probabilities (B,); differentiable w.r.t. the evidence and the buffers."""
        return torch.sigmoid(torch.stack(evidence, dim=-1).to(self.weight) @ self.weight + self.bias)

    def extra_repr(self) -> str:
        """The numbers, for printing."""
        pairs = zip(PoseEvidence._fields, self.weight.tolist(), strict=True)
        return ", ".join(f"{name}={value:.3g}" for name, value in pairs) + f", bias={float(self.bias):.3g}"

"""How good a pose hypothesis is: what the choice among several goes by."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry import project_points, transform_points
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import QueryPatches
from foundpose.retrieval.base import normalize_rows, spread_patches

# A patch of the crop sees the object where a patch of the template lands within so many cells of it.
_SEEN_WITHIN = 1.0
# Added to the half side of the square that a patch of the template covers, in cells: erosion leaves out the
# outermost.
_MARGIN = 0.1


class HypothesisScorer(nn.Module, ABC):
    """Scores pose hypotheses of the crops of one object; the best is kept. All of it is constant for autograd."""

    judges_poses: bool = True
    """Whether the score is one of the pose itself, so that refined poses can be compared by it, too."""

    @abstractmethod
    def forward(
        self,
        T_crop_from_model: Tensor,
        inlier_share: Tensor,
        query: QueryPatches,
        K_crop: Tensor,
        representation: ObjectRepresentation,
    ) -> Tensor:
        """Score n poses of each of B crops.

        Args:
            T_crop_from_model: (B, n, 4, 4), mesh units.
            inlier_share: (B, n) share of the crop's patches that are inliers.
            query: patches of the crops.
            K_crop: (B, 3, 3), pixels.
            representation: the object.

        Returns:
            (B, n) in [0, 1], the larger the better.
        """


class InlierScore(HypothesisScorer):
    """The share of the crop's patches that are inliers (the paper's quality, over the number of patches)."""

    judges_poses = False

    def forward(
        self,
        T_crop_from_model: Tensor,
        inlier_share: Tensor,
        query: QueryPatches,
        K_crop: Tensor,
        representation: ObjectRepresentation,
    ) -> Tensor:
        """The inliers' share as it is."""
        return inlier_share


class Agreement(NamedTuple):
    """How well crops agree with what poses say that they show.

    Attributes:
        similarity: (B, n) mean over the crop's patches of the cosine to the template's patch that lands on them; a
            patch on which none lands counts 0.
        coverage: (B, n) intersection over union of the cells that the template's patches cover and those of the
            crop's patches.
    """

    similarity: Tensor
    coverage: Tensor


class PatchVerification(HypothesisScorer):
    """Inliers, and whether the object, seen from that pose, looks like the crop and covers the same patches.

    Nothing is rendered: the template nearest to a pose shows the object nearly as it would look. Its patches are 3D
    points with descriptors; the pose projects them into the crop.

    The score is the weighted mean of the share of inliers, :class:`Agreement`'s similarity, and its coverage.
    Coverage tells most where masks are right, similarity where they are not.

    Args:
        similarity: weight of the similarity; inliers weigh 1.
        coverage: weight of the coverage.
        max_patches: the similarity is that of at most this many patches of a crop, evenly spread; None: of all.

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(self, similarity: float = 0.5, coverage: float = 1.0, max_patches: int | None = 128) -> None:
        super().__init__()
        if max_patches is not None and max_patches < 1:
            raise ValueError(f"max_patches must be at least 1 or None, got {max_patches}")
        if not (similarity >= 0 and coverage >= 0):
            raise ValueError(f"similarity and coverage must not be negative, got {similarity} and {coverage}")
        self.similarity = similarity
        self.coverage = coverage
        self.max_patches = max_patches

    def forward(
        self,
        T_crop_from_model: Tensor,
        inlier_share: Tensor,
        query: QueryPatches,
        K_crop: Tensor,
        representation: ObjectRepresentation,
    ) -> Tensor:
        """Score poses; see the class."""
        with torch.no_grad():
            found = pose_agreement(T_crop_from_model, query, K_crop, representation, self.max_patches)
            total = inlier_share + self.similarity * found.similarity.clamp(min=0.0)
            return (total + self.coverage * found.coverage) / (1.0 + self.similarity + self.coverage)

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"similarity={self.similarity}, coverage={self.coverage}, max_patches={self.max_patches}"


def pose_agreement(
    T_crop_from_model: Tensor,
    query: QueryPatches,
    K_crop: Tensor,
    representation: ObjectRepresentation,
    max_patches: int | None = None,
) -> Agreement:
    """Compare crops (B) with what n poses (B, n, 4, 4) of each say that they show; see :class:`PatchVerification`.

    Not differentiable: it is for choices.
    """
    n, info = T_crop_from_model.shape[1], representation.info
    views = representation.nearest_views(T_crop_from_model).squeeze(-1)
    patches = representation.gather_templates(views, components=1)  # their places; few descriptors are needed
    points = transform_points(T_crop_from_model, patches.points_model.to(T_crop_from_model))
    pixels, depth = project_points(points, K_crop.unsqueeze(1))
    landed = info.patch_grid.to_map(pixels)  # (B, n, Q, 2) cells
    usable = patches.valid & (depth > 0) & torch.isfinite(landed).all(dim=-1)
    # Far outside, where nothing is.
    landed = torch.where(usable.unsqueeze(-1), landed, landed.new_tensor(-1e4))

    inside = _mark(info.patch_grid.to_map(query.pixels).round().long(), query.valid, info.grid)
    query = spread_patches(query, max_patches)
    at_query = info.patch_grid.to_map(query.pixels).to(landed)
    distance = torch.cdist(at_query.unsqueeze(1).expand(-1, n, -1, -1), landed)
    nearest = distance.min(dim=3)
    seen = (nearest.values < _SEEN_WITHIN) & query.valid.unsqueeze(1)
    row = representation.template_offsets[views].unsqueeze(-1) + nearest.indices
    lies_there = representation.read_descriptors(row.clamp(max=len(representation.points_model) - 1))
    cosine = (normalize_rows(lies_there) * normalize_rows(query.descriptors.to(lies_there)).unsqueeze(1)).sum(
        -1
    )
    count = query.valid.sum(dim=1, keepdim=True).clamp(min=1)
    similarity = torch.where(seen, cosine, torch.zeros_like(cosine)).sum(dim=2) / count

    # A patch covers a square of its own size: too much, and the pose seems better the smaller the object is in the
    # crop.
    views_scale = _scale(
        representation.K_template[views], representation.T_template_from_model[views], points.dtype
    )
    half = 0.5 * _scale(K_crop.unsqueeze(1), T_crop_from_model, points.dtype) / views_scale + _MARGIN
    covered = _cover(landed, usable, half, info.grid)
    both = (covered & inside.unsqueeze(1)).sum(dim=2)
    either = (covered | inside.unsqueeze(1)).sum(dim=2)
    return Agreement(similarity, both / either.clamp(min=1))


def _mark(cells: Tensor, which: Tensor, grid: int) -> Tensor:
    """Which of the grid's cells (..., grid²) are among those given as (column, row) (..., N, 2)."""
    on_grid = which & ((cells >= 0) & (cells < grid)).all(dim=-1)
    index = (cells[..., 1] * grid + cells[..., 0]).masked_fill(~on_grid, grid * grid)
    marked = torch.zeros(*index.shape[:-1], grid * grid + 1, dtype=torch.bool, device=cells.device)
    return marked.scatter_(-1, index, torch.ones_like(on_grid))[..., :-1]


def _scale(K: Tensor, T_camera_from_model: Tensor, dtype: torch.dtype) -> Tensor:
    """Pixels (...) per mesh unit at the model's origin, under cameras (..., 3, 3) and poses (..., 4, 4)."""
    depth = T_camera_from_model[..., 2, 3].to(dtype)
    return K[..., 0, 0].to(dtype) / depth.clamp(min=torch.finfo(dtype).tiny)


def _cover(landed: Tensor, usable: Tensor, half: Tensor, grid: int) -> Tensor:
    """Which cells (..., grid²) have their centre in the square, of half sides (...), around a point (..., Q, 2)."""
    first = landed.round()
    covered = None
    # A square of up to three cells' side.
    for row in (-1.0, 0.0, 1.0):
        for column in (-1.0, 0.0, 1.0):
            cell = first + landed.new_tensor([column, row])
            near = usable & ((cell - landed).abs().amax(dim=-1) <= half.unsqueeze(-1))
            marked = _mark(cell.clamp(-1, grid).long(), near, grid)
            covered = marked if covered is None else covered | marked
    assert covered is not None
    return covered

"""Pose errors of the BOP benchmark: MSSD, MSPD, ADD and ADI, batched and exact, symmetries included.

The maxima over vertices and minima over symmetries are searched without a graph
(:mod:`foundpose.bop.worst_vertex`); the error is then evaluated at the vertex and symmetry that were found. So
gradients are those of the error, memory stays bounded, and the value is the same with and without autograd.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor, nn

from foundpose.bop.pose_pairs import check_model, check_pairs, finite_poses
from foundpose.bop.worst_vertex import (
    homogeneous,
    pixel_offsets,
    slices,
    surface_offsets,
    working_bytes,
    worst_vertices,
)
from foundpose.geometry import discretise, symmetries_from_models_info


class PoseErrors(NamedTuple):
    """Errors of B estimates; +inf where a pose is not finite.

    Attributes:
        mssd: (B,) maximum symmetry-aware surface distance, mesh units.
        mspd: (B,) maximum symmetry-aware projection distance, pixels, not normalised by the image's width.
    """

    mssd: Tensor
    mspd: Tensor


def mssd(T_est: Tensor, T_true: Tensor, vertices: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """Maximum symmetry-aware surface distance: min over S of max over x of ``|T_est x - T_true S x|``.

    Args:
        T_est: (B, 4, 4) estimated ``T_camera_from_model``.
        T_true: (B, 4, 4) true ones; used as they are, so a rotation may be slightly scaled.
        vertices: (V, 3) of the evaluation mesh. Those on the convex hull are enough: the distance is a convex
            function of x, which is largest there (:class:`ModelErrors` makes use of that).
        symmetries: (S, 4, 4) ``T_model_from_model``, the identity among them; None: the identity alone.

    Returns:
        (B,) in mesh units; +inf where a pose is not finite.

    Raises:
        ValueError: wrong shapes, no vertex, no symmetry, or dtypes and devices that differ.

    Differentiable w.r.t. all tensors, with the gradient of the vertex and symmetry that decide.

    Source: Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", section 2.2.
    """
    check_pairs(T_est, T_true, vertices, symmetries)
    est, true, finite = finite_poses(T_est, T_true)
    at = worst_vertices(est, true, vertices, symmetries, surface_offsets, working_bytes(vertices))
    worst = homogeneous(vertices[at.vertex, None])
    offsets = surface_offsets(est, _compose(true, symmetries, at.symmetry), worst)
    return _lengths(offsets, finite)


def mspd(
    T_est: Tensor,
    T_true: Tensor,
    K: Tensor,
    vertices: Tensor,
    symmetries: Tensor | None = None,
) -> Tensor:
    """Maximum symmetry-aware projection distance: as :func:`mssd` with projections to the image in place of points.

    Args:
        T_est: (B, 4, 4) estimated ``T_camera_from_model``.
        T_true: (B, 4, 4) true ones.
        K: (B, 3, 3) or (1, 3, 3) intrinsics in pixels, last row 0 0 1.
        vertices: (V, 3), all of the evaluation mesh.
        symmetries: (S, 4, 4) ``T_model_from_model``, the identity among them; None: the identity alone.

    Returns:
        (B,) in pixels of the image at hand (BOP multiplies by 640 / image width before it compares with a
        threshold); +inf where a pose or its intrinsics are not finite or a vertex lies in the plane of the camera.
        As in BOP, vertices behind the camera are projected like any other.

    Raises:
        ValueError: wrong shapes, no vertex, no symmetry, or dtypes and devices that differ.

    Differentiable w.r.t. all tensors, with the gradient of the vertex and symmetry that decide.

    Source: Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", section 2.2.
    """
    check_pairs(T_est, T_true, vertices, symmetries, K)
    est, true, finite = finite_poses(T_est, T_true, K)
    # The principal point moves both projections alike. Left out, it costs no digits.
    focal = torch.eye(3, dtype=K.dtype, device=K.device).repeat(len(est), 1, 1)
    focal[:, :2, :2] = torch.where(finite[:, None, None], K[:, :2, :2], focal[:, :2, :2])
    est, true = focal @ est, focal @ true
    at = worst_vertices(est, true, vertices, symmetries, pixel_offsets, working_bytes(vertices))
    worst = homogeneous(vertices[at.vertex, None])
    offsets = pixel_offsets(est, _compose(true, symmetries, at.symmetry), worst)
    return _lengths(offsets, finite)


def add(T_est: Tensor, T_true: Tensor, vertices: Tensor) -> Tensor:
    """Average distance of model points: mean over x of ``|T_est x - T_true x|``.

    Args:
        T_est: (B, 4, 4) estimated ``T_camera_from_model``.
        T_true: (B, 4, 4) true ones.
        vertices: (V, 3) of the evaluation mesh.

    Returns:
        (B,) in mesh units; +inf where a pose is not finite.

    Raises:
        ValueError: wrong shapes, no vertex, or dtypes and devices that differ.

    Differentiable w.r.t. all tensors.

    Source: Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects
    in heavily cluttered scenes", ACCV 2012.
    """
    check_pairs(T_est, T_true, vertices)
    est, true, finite = finite_poses(T_est, T_true)
    points = homogeneous(vertices)
    rows = 6 * points[0].nbytes
    errors = [
        torch.linalg.vector_norm(surface_offsets(est[part], true[part], points), dim=1).mean(dim=1)
        for part in slices(len(est), rows, working_bytes(vertices))
    ]
    return _infinite_unless(finite, torch.cat([est[:0, 0, 0], *errors]))


def adi(T_est: Tensor, T_true: Tensor, vertices: Tensor) -> Tensor:
    """Average distance to the nearest point, ADD-S: mean over x of min over y of ``|T_true x - T_est y|``.

    Every point is compared with every other: V² distances per pose, 4 to 7 ns each on a CPU core (0.1 to
    0.2 s for 5,000 vertices), so score many poses of large meshes on a GPU or with fewer vertices.

    Args:
        T_est: (B, 4, 4) estimated ``T_camera_from_model``.
        T_true: (B, 4, 4) true ones.
        vertices: (V, 3) of the evaluation mesh.

    Returns:
        (B,) in mesh units; +inf where a pose is not finite.

    Raises:
        ValueError: wrong shapes, no vertex, or dtypes and devices that differ.

    Differentiable w.r.t. all tensors (nearest points held fixed).

    Source: Hinterstoisser et al., ACCV 2012; as in BOP.
    """
    check_pairs(T_est, T_true, vertices)
    est, true, finite = finite_poses(T_est, T_true)
    # Seen from the middle between the poses: coordinates as small as they get keep the most digits.
    middle = 0.5 * (est[:, :, 3] + true[:, :, 3]).detach()
    points = homogeneous(vertices)
    budget = working_bytes(vertices)
    errors = [est[:0, 0, 0]]
    for part in slices(len(est), len(vertices) * points[0].nbytes, budget):
        ours, theirs = ((T[part] @ points - middle[part, :, None]).mT.contiguous() for T in (est, true))
        distances = []
        for some in slices(len(vertices), len(ours) * points[0].nbytes, budget):
            queries = theirs[:, some]  # (b, v, 3)
            nearest = torch.cdist(
                queries.detach(), ours.detach(), compute_mode="donot_use_mm_for_euclid_dist"
            ).argmin(dim=-1)
            found = ours.gather(1, nearest[..., None].expand(-1, -1, 3))
            distances.append(torch.linalg.vector_norm(queries - found, dim=-1))
        errors.append(torch.cat(distances, dim=1).mean(dim=1))
    return _infinite_unless(finite, torch.cat(errors))


class ModelErrors(nn.Module):
    """Errors of poses of one object.

    Args:
        vertices: (V, 3) of the evaluation mesh, float32 or float64; poses must have the same dtype.
        symmetries: (S, 4, 4) ``T_model_from_model``, the identity among them; None (default): no symmetry.
        diameter: of the object, mesh units; only kept, for thresholds. Default: not a number.

    Raises:
        ValueError: vertices or symmetries of a wrong shape or dtype, or not finite.

    Attributes:
        vertices: buffer (V, 3).
        hull: buffer (H, 3), the vertices of the convex hull, which are enough for MSSD.
        symmetries: buffer (S, 4, 4).
        diameter: as given.
        symmetric: whether there is another symmetry than the identity.
    """

    vertices: Tensor
    hull: Tensor
    symmetries: Tensor

    def __init__(
        self,
        vertices: Tensor,
        symmetries: Tensor | None = None,
        diameter: float = float("nan"),
    ) -> None:
        super().__init__()
        if symmetries is None:
            symmetries = torch.eye(4, dtype=vertices.dtype, device=vertices.device)[None]
        check_model(vertices, symmetries)
        if not bool(torch.isfinite(vertices).all()) or not bool(torch.isfinite(symmetries).all()):
            raise ValueError("vertices and symmetries must be finite, got NaN or infinity")
        self.register_buffer("vertices", vertices.detach().clone())
        self.register_buffer("hull", self.vertices[_hull_indices(vertices)])
        self.register_buffer("symmetries", symmetries.detach().clone())
        self.diameter = float(diameter)
        self.symmetric = len(symmetries) > 1

    @classmethod
    def from_models_info(cls, vertices: Tensor, entry: Mapping[str, Any], step: float = 0.01) -> Self:
        """Errors of an object as BOP describes it.

        Args:
            vertices: (V, 3) of the evaluation mesh.
            entry: of ``models_info.json``: ``diameter`` and, if any, the symmetries.
            step: how finely continuous symmetries are sampled, see :func:`foundpose.geometry.discretise`.

        Raises:
            ValueError: an entry without diameter, or with symmetries that are none.
        """
        if "diameter" not in entry:
            raise ValueError(
                f"an entry of models_info.json must have a diameter, got the keys {sorted(entry)}"
            )
        transforms, valid = discretise(symmetries_from_models_info(entry), step)
        return cls(vertices, transforms[valid].to(vertices), float(entry["diameter"]))

    def forward(self, T_est: Tensor, T_true: Tensor, K: Tensor) -> PoseErrors:
        """MSSD and MSPD of B pairs.

        Args:
            T_est: (B, 4, 4) estimated ``T_camera_from_model``.
            T_true: (B, 4, 4) true ones.
            K: (B, 3, 3) or (1, 3, 3) intrinsics, pixels.

        Returns:
            :class:`PoseErrors`. Differentiable w.r.t. the arguments.
        """
        return PoseErrors(
            mssd(T_est, T_true, self.hull, self.symmetries),
            mspd(T_est, T_true, K, self.vertices, self.symmetries),
        )

    def add_s(self, T_est: Tensor, T_true: Tensor) -> Tensor:
        """ADD-S (:func:`adi`) of an object with symmetries, :func:`add` of another: (B, 4, 4) twice → (B,)."""
        error = adi if self.symmetric else add
        return error(T_est, T_true, self.vertices)


def _hull_indices(vertices: Tensor) -> Tensor:
    """Indices of the vertices on the convex hull; all where they span no volume."""
    try:
        indices = ConvexHull(vertices.detach().double().cpu().numpy()).vertices
    except QhullError:
        return torch.arange(len(vertices), device=vertices.device)
    return torch.from_numpy(indices).to(vertices.device, torch.int64)


def _compose(true: Tensor, symmetries: Tensor | None, index: Tensor) -> Tensor:
    return true if symmetries is None else true @ symmetries[index]


def _lengths(offsets: Tensor, finite: Tensor) -> Tensor:
    """Lengths of offsets (B, 2 or 3, 1)."""
    return _infinite_unless(finite, torch.linalg.vector_norm(offsets.squeeze(-1), dim=-1))


def _infinite_unless(finite: Tensor, errors: Tensor) -> Tensor:
    return torch.where(finite & ~errors.isnan(), errors, torch.inf)

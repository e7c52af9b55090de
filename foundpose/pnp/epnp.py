"""EPnP: pose from four or more 2D-3D correspondences, all samples at once.

The camera-frame coordinates of a few control points span the object; the image fixes them up to a combination
β of null vectors, and the distances between the control points fix β. With exactly four correspondences the
correspondences themselves serve as control points: the null vectors are then the four rays, known without any
decomposition, and β are the distances along them.

Decompositions and iterations run on detached tensors and get their gradient afterwards: eigenvectors by first-order
perturbation, β by the implicit function theorem. Samples that determine no pose are swapped for a fixed one that does
and get the identity in the end, so that they neither have nor disturb a gradient.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform, transform_points
from foundpose.optimization.derivatives import attach_optimum, eigenbasis, safe_sqrt
from foundpose.pnp.problem import MinimalSolution, PnpProblem
from foundpose.pnp.weak_perspective import align_points, weak_perspective_depths
from foundpose.utils.devices import constant

# Relative squared area below which points count as collinear; far above float32's rounding.
_COLLINEAR = 1e-5
_REFINEMENT_STEPS = 5

# Cost, its Gauss-Newton matrix and gradient in β, and the errors of squared distances.
_Equations = tuple[Tensor, Tensor, Tensor, Tensor]


def solve_epnp(problem: PnpProblem) -> MinimalSolution:
    """Estimate poses by EPnP, planar and non-planar objects alike.

    For N > 4, candidates come from one, two and three null vectors by linearisation and from all of them by a
    weak-perspective start, once with four control points and once with three (flat objects); Gauss-Newton on
    β refines each and the smallest reprojection error wins. For N = 4 see the module's description; the two
    mirrored weak-perspective starts are the candidates there.

    Args:
        problem: B problems of N ≥ 4 correspondences. Points that are not valid, whose weight is not positive, or any
            number of which is not finite, are ignored. With N = 4 weights only tell whether all four are there.

    Returns:
        A :class:`MinimalSolution`. Bad samples are flagged; nothing is raised for them.

    Raises:
        ValueError: N < 4.

    Differentiable w.r.t. the points, ``K`` and, for N > 4, the weights (first
    derivatives), finite everywhere and zero for degenerate samples. It is the exact gradient of the least-squares
    optimum β of the winning candidate: equal to that of the returned pose where the five refinement steps have
    converged, as they mostly do, not so well under strong noise with N = 4. Which candidate wins is a choice and
    has no gradient; neither have turns inside repeated eigenspaces. So the derivative is one-sided or does not exist,
    and what comes out is that of one branch, where candidates tie (points that fit exactly, if N > 4), for N = 5
    where a single one of the two null vectors wins, and where two principal axes are equally long and the points
    do not fit exactly. For exactly flat objects the same holds for motion of model points out of their plane.

    Source: Lepetit, Moreno-Noguer and Fua, "EPnP: an accurate O(n) solution to the PnP problem", IJCV 2009.
    """
    count = problem.points_image.shape[1]
    if count < 4:
        raise ValueError(f"EPnP needs at least 4 correspondences, got N = {count}")
    problem, invertible = problem.clean()
    usable = problem.valid & invertible.unsqueeze(-1)
    if count == 4:
        usable = usable.all(-1, keepdim=True).expand_as(usable)
    bad = ~usable.unsqueeze(-1)
    rays = torch.where(bad, constant([0.0, 0.0, 1.0], problem.K), problem.rays())
    points_model = problem.points_model.masked_fill(bad, 0.0)
    if count == 4:
        return solve_epnp_minimal(rays, points_model)  # which flags four equal points
    return _solve_overdetermined(rays, points_model, problem.weights.masked_fill(~usable, 0.0))


def solve_epnp_minimal(rays: Tensor, points_model: Tensor) -> MinimalSolution:
    """EPnP from exactly four correspondences given as rays.

    Args:
        rays: (S, 4, 3) rays in the camera frame with z = 1, finite.
        points_model: (S, 4, 3) mesh units, finite.

    Returns:
        A :class:`MinimalSolution`. Differentiable as :func:`solve_epnp`.
    """
    weights = torch.full_like(rays[..., 0], 0.25)
    points, centroid, size = _normalise(points_model, weights)
    bearings = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    chord, distance = _squared_distances(bearings), _squared_distances(points)
    eps = torch.finfo(rays.dtype).eps
    off_diagonal = ~torch.eye(4, dtype=torch.bool, device=rays.device)
    repeated = (((distance < 1e-8) | (chord < eps**2)) & off_diagonal).any(-1).any(-1)
    degenerate = repeated | _collinear(points, weights)
    needs_gradient = rays.requires_grad or points.requires_grad
    if needs_gradient:
        rays, bearings, points = _stand_in(degenerate, rays, points)
        chord, distance = _squared_distances(bearings), _squared_distances(points)

    depths = weak_perspective_depths(bearings, points, weights)  # (S, 2, 4)
    chord, distance = chord.unsqueeze(1), distance.unsqueeze(1)

    def equations(beta: Tensor, chord: Tensor, distance: Tensor) -> _Equations:
        # |β_i r_i − β_j r_j|² = (β_i − β_j)² + β_i β_j |r_i − r_j|²: no cancellation in a narrow field of view.
        row, column = beta.unsqueeze(-1), beta.unsqueeze(-2)
        difference = row - column
        error = difference * difference + row * column * chord - distance
        slope = 2.0 * difference + column * chord  # of error (i, j) in β_i
        # A pair touches two unknowns only, so the Gauss-Newton matrix needs no product of Jacobians.
        H = slope * slope.transpose(-1, -2) + torch.diag_embed(slope.square().sum(-1))
        return 0.25 * error.square().sum((-1, -2)), H, (slope * error).sum(-1), error

    fixed = chord.detach(), distance.detach()
    depths = _refine(depths, lambda beta: equations(beta, *fixed), lower=eps)
    if needs_gradient:
        _, H, g, error = equations(depths, chord, distance)
        curvature = error * (chord - 2.0) + torch.diag_embed(2.0 * error.sum(-1))
        depths = attach_optimum(depths, H + curvature, g)
    T = align_points(depths.unsqueeze(-1) * bearings.unsqueeze(1), points.unsqueeze(1), weights.unsqueeze(1))
    return _best_candidate(T, rays, points, weights, centroid, size, degenerate)


def _solve_overdetermined(rays: Tensor, points_model: Tensor, weights: Tensor) -> MinimalSolution:
    used = weights > 0
    weights = weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    points, centroid, size = _normalise(points_model, weights)
    bearings = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    offset = (bearings - (weights.unsqueeze(-1) * bearings).sum(-2, keepdim=True)).abs().amax(-1)
    same_ray = (offset * used).amax(-1) <= 4.0 * torch.finfo(rays.dtype).eps
    degenerate = (used.sum(-1) < 4) | same_ray | _collinear(points, weights)
    rays, bearings, points = _stand_in(degenerate, rays, points)
    weights = torch.where(degenerate.unsqueeze(-1), 1.0 / weights.shape[-1], weights)

    variances, axes = eigenbasis(_spread(points, weights))
    extents, axes = safe_sqrt(variances).flip(-1), axes.flip(-1)
    starts = weak_perspective_depths(bearings, points, weights).unsqueeze(-1) * bearings.detach().unsqueeze(1)
    candidates = [
        _candidates(rays, points, weights, extents[:, :dimension], axes[..., :dimension], starts)
        for dimension in (3, 2)
    ]
    return _best_candidate(torch.cat(candidates, dim=1), rays, points, weights, centroid, size, degenerate)


def _candidates(
    rays: Tensor, points: Tensor, weights: Tensor, extents: Tensor, axes: Tensor, starts: Tensor
) -> Tensor:
    """Candidate poses (B, n, 4, 4) with control points at the centroid and along the given principal axes."""
    dtype, count = points.dtype, axes.shape[-1] + 1
    extents = extents.clamp(min=torch.finfo(dtype).eps ** 0.5)
    coordinates = (points @ axes) / extents.unsqueeze(-2)
    barycentric = torch.cat([1.0 - coordinates.sum(-1, keepdim=True), coordinates], dim=-1)  # (B, N, c)
    tips = (axes * extents.unsqueeze(-2)).transpose(-1, -2)
    controls = torch.cat([torch.zeros_like(tips[:, :1]), tips], dim=-2)  # (B, c, 3)

    # Each point gives two equations Σ_j α_j (X_j − x Z_j) = 0 and Σ_j α_j (Y_j − y Z_j) = 0.
    weighted = barycentric * safe_sqrt(weights).unsqueeze(-1)
    zero = torch.zeros_like(weighted)
    row_x = torch.stack([weighted, zero, -weighted * rays[..., :1]], dim=-1).flatten(-2)
    row_y = torch.stack([zero, weighted, -weighted * rays[..., 1:2]], dim=-1).flatten(-2)
    M = torch.cat([row_x, row_y], dim=-2)
    _, vectors = eigenbasis(M.transpose(-1, -2) @ M)
    null = vectors[..., :count].transpose(-1, -2).unflatten(-1, (count, 3))  # (B, k, c, 3), k = c

    i, j = torch.triu_indices(count, count, offset=1, device=points.device)
    edges = null[..., i, :] - null[..., j, :]  # (B, k, pairs, 3)
    gram = torch.einsum("bkpx,blpx->bpkl", edges, edges)
    distance = (controls[:, i] - controls[:, j]).square().sum(-1)
    fixed = gram.detach(), distance.detach()
    of_starts = _betas_of_start(null.detach(), barycentric.detach(), weights.detach(), starts)
    beta = torch.cat([_linearised_betas(*fixed), of_starts], dim=1).nan_to_num(0.0, 0.0, 0.0)
    free = torch.ones_like(beta, dtype=torch.bool)
    for vectors_used in range(1, count):
        free[:, vectors_used - 1, vectors_used:] = False

    def equations(beta: Tensor, gram: Tensor, distance: Tensor) -> _Equations:
        half_slope = torch.einsum("bpkl,bnl->bnpk", gram, beta)
        error = torch.einsum("bnpk,bnk->bnp", half_slope, beta) - distance.unsqueeze(1)
        J = 2.0 * half_slope * free.unsqueeze(-2)
        H = J.transpose(-1, -2) @ J
        g = (J.transpose(-1, -2) @ error.unsqueeze(-1)).squeeze(-1)
        return 0.5 * error.square().sum(-1), H, g, error

    beta = _refine(beta, lambda beta: equations(beta, *fixed))
    if gram.requires_grad or distance.requires_grad:
        _, H, g, error = equations(beta, gram, distance)
        curvature = 2.0 * torch.einsum("bnp,bpkl->bnkl", error, gram)
        beta = attach_optimum(beta, H + curvature * (free.unsqueeze(-1) & free.unsqueeze(-2)), g)
    controls_camera = torch.einsum("bnk,bkcx->bncx", beta, null)
    points_camera = barycentric.unsqueeze(1) @ controls_camera
    mean_depth = (weights.unsqueeze(1) * points_camera[..., 2]).sum(-1)
    facing = torch.where(mean_depth < 0, -1.0, 1.0).to(dtype)[..., None, None]
    return align_points(facing * points_camera, points.unsqueeze(1), weights.unsqueeze(1))


def _linearised_betas(gram: Tensor, distance: Tensor) -> Tensor:
    """β for 1 … c − 1 null vectors, the products β_k β_l taken as unknowns: (B, P, k, k) → (B, c − 1, k)."""
    size = gram.shape[-1]
    length = gram[..., 0, 0].clamp(min=0.0).sqrt()
    tiny = torch.finfo(gram.dtype).tiny
    scale = (length * distance.sqrt()).sum(-1) / length.square().sum(-1).clamp(min=tiny)
    betas = [torch.nn.functional.pad(scale.unsqueeze(-1), (0, size - 1))]
    for used in range(2, size):
        k, m = torch.triu_indices(used, used, device=gram.device)
        L = gram[..., k, m] * torch.where(k == m, 1.0, 2.0).to(gram.dtype)
        normal = L.transpose(-1, -2) @ L
        trace = normal.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        ridge = (torch.finfo(gram.dtype).eps * trace + tiny) * torch.eye(
            len(k), dtype=L.dtype, device=L.device
        )
        products = torch.linalg.solve_ex(normal + ridge, L.transpose(-1, -2) @ distance.unsqueeze(-1))[0]
        products = products.squeeze(-1)
        squares, with_first = products[:, k == m], products[:, :used]
        sign = torch.where(with_first * with_first[:, :1] < 0, -1.0, 1.0).to(gram.dtype)
        betas.append(torch.nn.functional.pad(sign * squares.abs().sqrt(), (0, size - used)))
    return torch.stack(betas, dim=1)


def _betas_of_start(null: Tensor, barycentric: Tensor, weights: Tensor, starts: Tensor) -> Tensor:
    """Coefficients (B, 2, k) of the control points that best explain given camera points (B, 2, N, 3)."""
    weighted = (barycentric * weights.unsqueeze(-1)).transpose(-1, -2)
    normal = weighted @ barycentric
    ridge = torch.finfo(null.dtype).eps * torch.eye(normal.shape[-1], dtype=null.dtype, device=null.device)
    controls = torch.linalg.solve_ex((normal + ridge).unsqueeze(1), weighted.unsqueeze(1) @ starts)[0]
    return torch.einsum("bkcx,bncx->bnk", null, controls)


def _refine(beta: Tensor, equations: Callable[[Tensor], _Equations], lower: float | None = None) -> Tensor:
    """Damped Gauss-Newton on β (..., k), which stays above ``lower`` if given. Give it detached tensors."""
    identity = torch.eye(beta.shape[-1], dtype=beta.dtype, device=beta.device)
    cost, H, g, _ = equations(beta)
    damping = torch.full_like(cost, 1e-3)
    for step in range(_REFINEMENT_STEPS):
        diagonal = H.diagonal(dim1=-2, dim2=-1)
        ridge = 1e-3 * torch.finfo(beta.dtype).eps * diagonal.amax(-1, keepdim=True) + 1e-30
        damped = H + (damping.unsqueeze(-1) * diagonal + ridge).unsqueeze(-1) * identity
        new = beta - torch.linalg.solve_ex(damped, g.unsqueeze(-1))[0].squeeze(-1)
        cost_new, H_new, g_new, _ = equations(new)
        better = cost_new <= cost
        if lower is not None:
            better = better & (new > lower).all(-1)
        beta = torch.where(better.unsqueeze(-1), new, beta)
        if step + 1 == _REFINEMENT_STEPS:
            break
        cost = torch.where(better, cost_new, cost)
        H = torch.where(better[..., None, None], H_new, H)
        g = torch.where(better.unsqueeze(-1), g_new, g)
        damping = torch.where(better, damping * 0.1, damping * 10.0)
    return beta


def _normalise(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Move points (S, N, 3) to weighted centroid zero and root mean square one; also the centroid and size.

    The pose does not depend on the size that the points are solved at, so it has no gradient.
    """
    centroid = (weights.unsqueeze(-1) * points).sum(-2, keepdim=True)
    centred = points - centroid
    size = (weights * centred.square().sum(-1)).sum(-1).detach().sqrt()[:, None]
    size = torch.where(size > 0, size, torch.ones_like(size))
    return centred / size.unsqueeze(-1), centroid.squeeze(-2), size


def _stand_in(degenerate: Tensor, rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays, bearings and points of solvable problems, the same one for all degenerate samples."""
    cloud = torch.arange(3.0 * points.shape[1], dtype=points.dtype, device=points.device).square().sin()
    cloud = cloud.unflatten(0, (-1, 3))
    ahead = cloud + constant([0.0, 0.0, 4.0], cloud)
    rays = torch.where(degenerate[:, None, None], ahead / ahead[:, 2:], rays)
    bearings = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    return rays, bearings, torch.where(degenerate[:, None, None], cloud, points)


def _squared_distances(points: Tensor) -> Tensor:
    """(S, N, 3) → (S, N, N)."""
    return (points.unsqueeze(-2) - points.unsqueeze(-3)).square().sum(-1)


def _spread(points: Tensor, weights: Tensor) -> Tensor:
    return (weights.unsqueeze(-1) * points).transpose(-1, -2) @ points


def _collinear(points: Tensor, weights: Tensor) -> Tensor:
    """Whether centred points lie on a line (or a point), by the sum of the covariance's principal 2-minors."""
    spread = _spread(points, weights)
    trace = spread.diagonal(dim1=-2, dim2=-1).sum(-1)
    return 0.5 * (trace * trace - spread.square().sum((-1, -2))) <= _COLLINEAR * trace * trace


def _best_candidate(
    T: Tensor,
    rays: Tensor,
    points: Tensor,
    weights: Tensor,
    centroid: Tensor,
    size: Tensor,
    degenerate: Tensor,
) -> MinimalSolution:
    """Pick by reprojection error among candidates (S, n, 4, 4) for normalised points, and undo the scaling."""
    points_camera = transform_points(T.detach(), points.detach().unsqueeze(1))
    depth = points_camera[..., 2]
    used = (weights > 0).unsqueeze(1)
    behind = ((depth <= 0) & used).any(-1)
    plane = points_camera[..., :2] / torch.where(depth > 0, depth, torch.ones_like(depth)).unsqueeze(-1)
    squared = (plane - rays[..., :2].detach().unsqueeze(1)).square().sum(-1)
    error = (weights.detach().unsqueeze(1) * squared).sum(-1).masked_fill(behind, torch.inf)
    best = error.argmin(dim=-1)
    T = torch.take_along_dim(T, best[:, None, None, None], dim=1).squeeze(1)
    in_front = ~torch.take_along_dim(behind, best[:, None], dim=1).squeeze(1)
    R = T[:, :3, :3]
    t = size * T[:, :3, 3] - (R @ centroid.unsqueeze(-1)).squeeze(-1)
    T = make_transform(R, t)
    solved = torch.isfinite(T).all(-1).all(-1) & ~degenerate
    T = torch.where(solved[:, None, None], T, torch.eye(4, dtype=T.dtype, device=T.device))
    return MinimalSolution(T, in_front & solved, degenerate)

"""The reprojection error: of poses, as a cost to be minimised, and truncated at a threshold."""

from collections.abc import Callable

import torch
from torch import Tensor

from foundpose.optimization import NormalEquations, RobustLoss
from foundpose.optimization.local_frame import LocalFrame, LocalProjection
from foundpose.pnp.problem import PnpProblem


def reprojection_cost(
    problem: PnpProblem, frame: LocalFrame, loss: RobustLoss
) -> Callable[[Tensor], NormalEquations]:
    """The cost ``½ Σ w ρ(‖π(K, T x) − u‖²)`` of B problems, as a function of poses in a local frame.

    Args:
        problem: correspondences; those of weight zero are left out.
        frame: where the local frames lie.
        loss: ρ on squared pixel distances.

    Returns:
        A function of ``T_local`` (B, 4, 4) that gives the :class:`NormalEquations` of ``T_local ← exp(δ) @ T_local``;
        the cost is infinite where a weighted point lies behind the camera. Differentiable w.r.t. all tensors.
    """
    project = LocalProjection(frame, problem.points_model, problem.K)
    target = problem.points_image.transpose(1, 2).contiguous()
    weights, used = problem.weights, problem.weights > 0
    unused = ~used

    def evaluate(T_local: Tensor) -> NormalEquations:
        pixels, depth, J = project(T_local)
        residual = pixels - target
        rho, slope = loss(residual.square().sum(1))
        # Points out of use may lie anywhere, also where their residual overflows.
        cost = 0.5 * (weights * rho.masked_fill(unused, 0.0)).sum(-1)
        cost = cost.masked_fill((used & (depth <= 0)).any(-1), torch.inf)
        share = weights * slope
        J = J.flatten(2)
        weighted = J * torch.cat([share, share], dim=-1).unsqueeze(1)
        H = torch.bmm(weighted, J.transpose(1, 2))
        g = torch.bmm(weighted, residual.flatten(1).unsqueeze(-1)).squeeze(-1)
        return NormalEquations(cost, H, g)

    return evaluate


def reprojection_errors(T: Tensor, problem: PnpProblem) -> tuple[Tensor, Tensor]:
    """Squared pixel distances and depths of projected points.

    Products and sums are written out: matrix routines may round differently for another amount of padding or
    another batch size, which could turn an inlier at the threshold into an outlier.

    Args:
        T: (B, ..., 4, 4) poses, one or more for each problem.
        problem: B problems of N correspondences.

    Returns:
        Squared distances (B, ..., N), px², and depths (B, ..., N), mesh units. Where the depth is not positive the
        distance means nothing. Differentiable w.r.t. all tensors.
    """
    rows = (slice(None), *[None] * (T.dim() - 3))
    K = problem.K[rows]
    x, y, z = (T[..., :3, :3, None] * problem.points_model[rows].transpose(-1, -2).unsqueeze(-3)).unbind(-2)
    camera = x + y + z + T[..., :3, 3:]
    depth = camera[..., 2, :]
    plane = camera[..., :2, :] * torch.where(depth > 0, depth, 1.0).reciprocal().unsqueeze(-2)
    x, y = (K[..., :2, :2, None] * plane.unsqueeze(-3)).unbind(-2)
    residual = x + y + (K[..., :2, 2:] - problem.points_image[rows].transpose(-1, -2))
    u, v = residual.square().unbind(-2)
    return u + v, depth


def select_inliers(
    T: Tensor, problem: PnpProblem, threshold: float, loss: RobustLoss
) -> tuple[Tensor, Tensor]:
    """Inliers (B, N) of one pose (B, 4, 4) per problem, and its truncated cost (B,) in px²; constants.

    The truncated cost counts an inlier by its loss and all others by the loss at the threshold. The polish on
    the inliers never raises it, while it may well lose an inlier of a pose that was chosen for having many:
    the winner of hundreds of samples tends to bend towards a few outliers.
    """
    squared, depth = reprojection_errors(T.detach(), problem.detach())
    inliers = (squared <= threshold**2) & (depth > 0) & problem.valid
    truncated = torch.where(inliers, squared, threshold**2)
    return inliers, (loss(truncated)[0].detach() * problem.weights.detach()).sum(-1)

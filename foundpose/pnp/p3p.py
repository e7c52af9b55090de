"""Perspective-three-Point: all poses that three correspondences allow, all samples at once.

The distances of the points come from :mod:`foundpose.pnp.distances`; here are the poses that follow from them. Inside
this module, too, the samples are the last dimension and sums are written out.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform
from foundpose.pnp.distances import solve_distances, total
from foundpose.pnp.problem import MinimalSolution, PnpProblem, usable_coordinates

_LARGEST_SLOPE = 100.0  # x / z of a ray; no pinhole camera sees as far from its axis


class P3PSolutions(NamedTuple):
    """Up to four poses per sample.

    Attributes:
        T_camera_from_model: (B, 4, 4, 4), always finite. The valid roots come first, by growing distance of the
            first point; the others are identities.
        valid: (B, 4) bool, a real root with all three points in front of the camera and on their rays. A double
            root may appear once or twice.
        degenerate: (B,) bool, the sample does not determine poses: collinear or coincident points, two points on
            one ray, input that is not finite, or intrinsics without inverse. (Three rays in one plane are fine.)
    """

    T_camera_from_model: Tensor
    valid: Tensor
    degenerate: Tensor


def solve_p3p(problem: PnpProblem) -> P3PSolutions:
    """All poses that bring three model points onto the rays through three pixels.

    Args:
        problem: B problems of N = 3 correspondences, all of which must be valid; weights do not matter.

    Returns:
        :class:`P3PSolutions`. Bad samples are flagged; nothing is raised for them.

    Raises:
        ValueError: N is not 3.

    Differentiable w.r.t. the points and ``K``, as :func:`solve_p3p_rays`; its source too.
    """
    if problem.points_image.shape[1] != 3:
        raise ValueError(f"P3P needs exactly 3 correspondences, got N = {problem.points_image.shape[1]}")
    problem, invertible = problem.clean()
    usable = problem.valid.all(-1) & invertible
    rays = problem.rays().masked_fill(~usable[:, None, None], 0.0)
    return solve_p3p_rays(rays, problem.points_model)  # which flags three equal rays


def solve_p3p_rays(rays: Tensor, points_model: Tensor) -> P3PSolutions:
    """All poses that bring three model points onto three rays.

    Args:
        rays: (S, 3, 3) rays in the camera frame with z = 1.
        points_model: (S, 3, 3) mesh units.

    Returns:
        :class:`P3PSolutions`.

    Measured: in float64 the true pose is among the roots to 1e-6 for 99.99 % of random triangles, and for 95 % where
    it is a double root. float32's median error is twice that of its rounded input, more for flat triangles.

    Differentiable w.r.t. ``rays`` and ``points_model`` (first derivatives), exactly, at simple roots: the roots are
    found on detached tensors and get their gradient from one Newton step, by the implicit function theorem. At a
    double root the derivative does not exist; there it comes out finite, and zero at poses that are not valid.

    Source: the pencil of conics follows Persson and Nordberg, "Lambda Twist: an accurate fast robust perspective
    three point (P3P) solver", ECCV 2018, and Ding et al., "Revisiting the P3P problem", CVPR 2023.
    """
    roots = triangle_roots(rays, points_model)
    # Invalid poses get the greatest distance there is, and so the last places.
    key = roots.distance.detach().masked_fill(~roots.valid, torch.inf)
    T, valid = roots.poses(key.argsort(dim=0, stable=True))
    return P3PSolutions(T, valid, roots.degenerate)


def solve_p3p_minimal(rays: Tensor, points_model: Tensor) -> MinimalSolution:
    """P3P on the first three of four correspondences; the fourth chooses among the roots.

    Args:
        rays: (S, 4, 3) rays in the camera frame with z = 1, finite.
        points_model: (S, 4, 3) mesh units, finite.

    Returns:
        A :class:`MinimalSolution`.
    """
    roots = triangle_roots(rays[:, :3], points_model[:, :3])
    x, y, depth = roots.see(points_model[:, 3].T)
    ahead = roots.valid & (depth > 0)
    depth = torch.where(ahead, depth, 1.0)
    error = (x / depth - rays[:, 3, 0]).square() + (y / depth - rays[:, 3, 1]).square()
    best = error.masked_fill(~ahead, torch.inf).min(dim=0, keepdim=True).indices
    return MinimalSolution(roots.poses(best)[0].squeeze(1), ahead.any(0), roots.degenerate)


class TriangleRoots(NamedTuple):
    """The triangle of three points as up to four roots see it, samples last.

    Attributes:
        camera: (3 axes, 3, 4, S) the triangle's axes in the camera frame.
        distance: (4, S) of the first point from the camera.
        valid: (4, S) bool.
        model: (3 axes, 3, S) the triangle's axes in the model frame.
        corner: (3, S) the first point, mesh units.
        bearing: (3, S) unit ray to it.
        degenerate: (S,) bool.
    """

    camera: Tensor
    distance: Tensor
    valid: Tensor
    model: Tensor
    corner: Tensor
    bearing: Tensor
    degenerate: Tensor

    def see(self, point: Tensor) -> Tensor:
        """Where the roots put a model point (3, S): (3, 4, S) in the camera frame."""
        along = _dot(self.model.transpose(0, 1), (point - self.corner).unsqueeze(1))
        return self.distance * self.bearing.unsqueeze(1) + _dot(self.camera, along[:, None, None])

    def poses(self, order: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (S, k, 4, 4) of some roots (k, S) of each sample, and which are valid (S, k); else identities."""
        numbers = torch.cat([self.camera.flatten(0, 1), self.distance.unsqueeze(0)])
        numbers = numbers.gather(1, order.expand(10, -1, -1))
        camera, distance = numbers[:9].unflatten(0, (3, 3)), numbers[9]
        R = _dot(camera.unsqueeze(2), self.model[:, None, :, None])  # (3, 3, k, S)
        t = distance * self.bearing.unsqueeze(1) - _dot(R.transpose(0, 1), self.corner[:, None, None])
        valid = self.valid.gather(0, order)
        identity = torch.eye(3, dtype=R.dtype, device=R.device)
        R = torch.where(valid, R, identity[..., None, None])
        T = make_transform(R.permute(3, 2, 0, 1), torch.where(valid, t, 0.0).permute(2, 1, 0))
        return T, valid.T


def triangle_roots(rays: Tensor, points_model: Tensor) -> TriangleRoots:
    """What :func:`solve_p3p_rays` makes poses of; arguments, gradients and source as there."""
    eps, tiny = torch.finfo(rays.dtype).eps, torch.finfo(rays.dtype).tiny
    points, x, y = points_model.permute(2, 1, 0).contiguous(), *rays[..., :2].permute(2, 1, 0).contiguous()
    usable = usable_coordinates(points.detach().flatten(0, 1).T) & (_extent(points) > tiny**0.5)
    slopes = torch.stack([x, y]).detach()  # (2, 3 points, S)
    usable = usable & (slopes.abs().amax((0, 1)) < _LARGEST_SLOPE) & (_extent(slopes) > 4.0 * eps)
    # Samples without any size would make square roots of zero; other degenerate ones can be computed with.
    stand_in = torch.eye(3, dtype=rays.dtype, device=rays.device).unsqueeze(-1)
    points = torch.where(usable, points, stand_in)
    x, y = torch.where(usable, x, 0.1 * stand_in[0]), torch.where(usable, y, 0.1 * stand_in[1])

    first, second = _pairs(points)
    size = _extent(points)  # a scale is a free choice, so it needs no gradient
    edges = (second - first) / size  # (3 coordinates, 3 pairs, S)
    lengths = _dot(edges, edges)  # (3 pairs, S), squared
    bearings, offsets = _bearings(x, y)
    chords = _dot(offsets, offsets)
    epsilon = total(chords).detach().sqrt()
    C = chords / (epsilon * epsilon)
    model, corner_model = _frame(edges[:, 0], edges[:, 1], eps)
    # Twice the area against the sides: float32 knows the height of a triangle to about 1e-4 of its length.
    flat = corner_model[0] * corner_model[2] <= 2.0 * eps**0.5 * total(lengths.detach())
    degenerate = ~usable | flat | (chords.amin(0) <= (4.0 * eps) ** 2)

    X, Y, sigma, candidate = solve_distances(C, lengths, epsilon)

    # The triangle in the camera frame, seen from its first corner: d_j b_j − d_1 b_1 without cancellation.
    s = sigma.sqrt()
    distance = s / epsilon
    steps = torch.stack([s * X, s * Y])
    sides = steps * bearings[:, 1:].unsqueeze(2) + distance * offsets[:, :2].unsqueeze(2)  # (3, 2, 4, S)
    camera, corner_camera = _frame(sides[:, 0], sides[:, 1], eps)
    mismatch = corner_camera - corner_model.unsqueeze(1)
    # 1e-4 of the triangle's size in float32, 1e-9 in float64.
    valid = candidate & ~degenerate & (_dot(mismatch, mismatch) <= eps**1.15 * total(lengths))
    return TriangleRoots(camera, size * distance, valid, model, points[:, 0], bearings[:, 0], degenerate)


def _bearings(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Unit rays (3 coordinates, 3 points, S), and their differences (3 coordinates, 3 pairs, S), put together from
    the differences of the rays and of their squared lengths: subtracting unit rays would lose digits."""
    norm = (x * x + y * y + 1.0).sqrt()
    rays = torch.stack([x, y, norm])
    first, second = _pairs(rays)
    (gap_x, gap_y, _), (sum_x, sum_y, sum_norm) = (second - first).unbind(0), (first + second).unbind(0)
    (x_first, y_first, norm_first), norm_second = first.unbind(0), second[2]
    # 1 / n_i − 1 / n_j
    shrink = (gap_x * sum_x + gap_y * sum_y) / (norm_first * norm_second * sum_norm)
    offsets = [gap_x / norm_second - x_first * shrink, gap_y / norm_second - y_first * shrink, -shrink]
    return torch.stack([x, y, torch.ones_like(x)]) / norm, torch.stack(offsets)


def _frame(side_a: Tensor, side_b: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Axes (3 axes, 3, ...) of a triangle from two sides (3, ...), and its coordinates that are not zero there."""
    normal = _cross(side_a, side_b)
    # The bounds matter for flat triangles only, which are not valid.
    length = _dot(side_a, side_a).clamp(min=eps * eps).sqrt()
    area = _dot(normal, normal).clamp(min=eps * eps).sqrt()
    first, third = side_a / length, normal / area
    corners = torch.stack([length, _dot(first, side_b), area / length])
    return torch.stack([first, _cross(third, first), third]), corners


def _pairs(x: Tensor) -> tuple[Tensor, Tensor]:
    """First and second members of the pairs (0, 1), (0, 2), (1, 2) along dimension 1."""
    return torch.cat([x[:, :1], x[:, :2]], dim=1), torch.cat([x[:, 1:], x[:, 2:]], dim=1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products along dimension 0."""
    return total(a * b)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products along dimension 0."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(0), b.unbind(0)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _extent(points: Tensor) -> Tensor:
    """Largest side (S,) of the box around points (d, N, S), a constant."""
    points = points.detach()
    return (points.amax(1) - points.amin(1)).amax(0)

"""Exact search for the vertex with the largest error under the symmetry with the smallest such error.

Poses here are (..., 3, 4) matrices and points homogeneous columns (4, V), so that all coordinates of many poses come
out of one matrix product, contiguous along the vertices.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

Offsets = Callable[[Tensor, Tensor, Tensor], Tensor]


class WorstVertices(NamedTuple):
    """What decides the error of each of B pairs of poses.

    Attributes:
        symmetry: (B,) index of the symmetry under which the worst vertex is nearest.
        vertex: (B,) index of that vertex.
    """

    symmetry: Tensor
    vertex: Tensor


def homogeneous(points: Tensor) -> Tensor:
    """Points as columns: (..., V, 3) → (..., 4, V), the last row 1."""
    return torch.cat([points, torch.ones_like(points[..., :1])], dim=-1).mT.contiguous()


def surface_offsets(est: Tensor, true: Tensor, points: Tensor) -> Tensor:
    """Vectors from points under one pose to the same points under another.

    Args:
        est: (..., 3, 4) poses.
        true: (..., 3, 4), leading dimensions broadcast.
        points: (4, V) for all, or (B, 4, V) for the entries of the first dimension.

    Returns:
        (..., 3, V). Differentiable w.r.t. all arguments.
    """
    return _map(est - true, points)


def pixel_offsets(est: Tensor, true: Tensor, points: Tensor) -> Tensor:
    """As :func:`surface_offsets` between projections, with poses multiplied by intrinsics: (..., 2, V)."""
    return _project(_map(est, points)) - _project(_map(true, points))


def working_bytes(vertices: Tensor) -> int:
    """About how much memory to work with at a time: on the CPU what fits into its cache."""
    return 2**22 if vertices.device.type == "cpu" else 2**28


def slices(count: int, bytes_each: int, budget: int) -> Iterator[slice]:
    """Cut ``count`` things into runs that need no more than ``budget`` bytes, or into single ones."""
    size = max(budget // bytes_each, 1)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def worst_vertices(
    est: Tensor, true: Tensor, vertices: Tensor, symmetries: Tensor | None, offsets: Offsets, budget: int
) -> WorstVertices:
    """Find, for each pair, min over symmetries of max over vertices of the length of an offset.

    Args:
        est: (B, 3, 4) poses.
        true: (B, 3, 4) poses, to which symmetries apply.
        vertices: (V, 3).
        symmetries: (S, 4, 4) or None.
        offsets: :func:`surface_offsets` or :func:`pixel_offsets`.
        budget: bytes to work with, more or less.

    Returns:
        :class:`WorstVertices`; a length that is not a number counts as infinite. It is exact: symmetries are left
        out only where a vertex shows that they cannot be the best by more than rounding. Not differentiable.
    """
    est, true, points = est.detach(), true.detach(), homogeneous(vertices.detach())
    symmetry = torch.zeros(len(est), dtype=torch.int64, device=est.device)
    if symmetries is None or len(symmetries) == 1:
        if symmetries is not None:
            true = true @ symmetries[0].detach()
        return WorstVertices(symmetry, _farthest(est, true, points, offsets, budget)[1])
    vertex = torch.zeros_like(symmetry)
    columns = symmetries.detach().transpose(0, 1).flatten(1)  # (4, S·4)
    few = _extremes(points)
    for part in slices(len(est), 3 * 3 * columns[0].nbytes, budget):
        every = (true[part].reshape(-1, 4) @ columns).reshape(-1, 3, len(symmetries), 4).transpose(1, 2)
        symmetry[part], vertex[part] = _best_symmetry(
            est[part], every.contiguous(), points, few, offsets, budget
        )
    return WorstVertices(symmetry, vertex)


def _best_symmetry(
    est: Tensor, true: Tensor, points: Tensor, few: Tensor, offsets: Offsets, budget: int
) -> WorstVertices:
    """Branch and bound over symmetries.

    Any set of vertices gives a lower bound of each symmetry's largest error. The symmetries with the lowest bounds
    are measured with all vertices; their worst vertices, which are usually almost the worst under other symmetries
    too, then raise everybody's bounds. That goes on until no bound is below the best value found.

    Args:
        est: (B, 3, 4).
        true: (B, S, 3, 4), with each symmetry.
        points: (4, V).
        few: (4, E), some points to begin with.
        offsets: which error.
        budget: bytes to work with.
    """
    S = true.shape[1]
    lower = _lower_bounds(est, true, few, offsets, budget)
    best = lower.new_full((len(est),), torch.inf)
    symmetry = torch.zeros(len(est), dtype=torch.int64, device=est.device)
    vertex = torch.zeros_like(symmetry)
    slack = 1.0 - 16.0 * torch.finfo(est.dtype).eps
    todo, count = torch.arange(len(est), device=est.device), 1
    while len(todo):
        candidates = lower[todo].topk(count, dim=1, largest=False).indices
        value, worst = _farthest(
            est[todo].repeat_interleave(count, dim=0),
            true[todo[:, None], candidates].flatten(0, 1),
            points,
            offsets,
            budget,
        )
        worst = worst.unflatten(0, candidates.shape)
        value, first = value.unflatten(0, candidates.shape).min(dim=1, keepdim=True)
        better = value.squeeze(1) <= best[todo]  # "or equal", for errors that are all infinite
        best[todo] = torch.where(better, value.squeeze(1), best[todo])
        symmetry[todo] = torch.where(better, candidates.gather(1, first).squeeze(1), symmetry[todo])
        vertex[todo] = torch.where(better, worst.gather(1, first).squeeze(1), vertex[todo])

        seen_there = points[:, worst].transpose(0, 1)  # (b, 4, count)
        bounds = _lower_bounds(est[todo], true[todo], seen_there, offsets, budget)
        lower[todo] = torch.maximum(lower[todo], bounds).scatter(1, candidates, torch.inf)
        todo = todo[lower[todo].amin(dim=1) < best[todo] * slack]
        # Hard cases have many near ties: twice as many next time, so that rounds stay few.
        count = min(2 * count, 16, S)
    return WorstVertices(symmetry, vertex)


def _lower_bounds(est: Tensor, true: Tensor, points: Tensor, offsets: Offsets, budget: int) -> Tensor:
    """Largest squared lengths (B, S) at some points (4, E) or (B, 4, E), for est (B, 3, 4) and true (B, S, 3, 4)."""
    bytes_each = 6 * true.shape[1] * points[..., 0, :].nbytes // (len(points) if points.dim() == 3 else 1)
    own = points.dim() == 3
    bounds = [
        _squared(offsets(est[part, None], true[part], points[part] if own else points)).amax(dim=-1)
        for part in slices(len(est), bytes_each, budget)
    ]
    return torch.cat(bounds).nan_to_num_(nan=torch.inf, posinf=torch.inf)


def _farthest(
    est: Tensor, true: Tensor, points: Tensor, offsets: Offsets, budget: int
) -> tuple[Tensor, Tensor]:
    """Largest squared length (B,) over points (4, V) and where it is, for poses (B, 3, 4).

    The formulas of the offsets once more, in place in one buffer: this is where the time goes, and half of it would
    be spent on fresh memory.
    """
    value = est.new_empty(len(est))
    index = torch.empty(len(est), dtype=torch.int64, device=est.device)
    V = points.shape[1]
    poses = torch.stack([est, true]) if offsets is pixel_offsets else (est - true)[None]  # (1 or 2, B, 3, 4)
    parts = list(slices(len(est), 6 * points[0].nbytes, budget))
    buffer = points.new_empty(6 * max((part.stop - part.start for part in parts), default=0) * V)
    for part in parts:
        some = poses[:, part].reshape(-1, 4)
        mapped = torch.mm(some, points, out=buffer[: len(some) * V].view(-1, V)).view(len(poses), -1, 3, V)
        if offsets is pixel_offsets:
            pixels = mapped[:, :, :2].mul_(mapped[:, :, 2:].reciprocal_())
            x, y = pixels[0].sub_(pixels[1]).square_().unbind(1)
            squared = x.add_(y)
        else:
            x, y, z = mapped[0].square_().unbind(1)
            squared = x.add_(y).add_(z)
        value[part], index[part] = squared.max(dim=-1)
    return value.nan_to_num_(nan=torch.inf, posinf=torch.inf), index


def _extremes(points: Tensor) -> Tensor:
    """The points (4, V) that are farthest out in 26 directions: (4, 26), with repetitions."""
    steps = torch.arange(-1, 2, dtype=points.dtype, device=points.device)
    directions = torch.cartesian_prod(steps, steps, steps)
    directions = torch.cat([directions[:13], directions[14:]])  # less the zero in the middle
    return points[:, (directions @ points[:3]).argmax(dim=1)].contiguous()


def _map(T: Tensor, points: Tensor) -> Tensor:
    if points.dim() == 2:
        return (T.reshape(-1, 4) @ points).unflatten(0, T.shape[:-1])
    return (T.flatten(1, -2) @ points).unflatten(1, T.shape[1:-1])


def _project(x: Tensor) -> Tensor:
    return x[..., :2, :] * x[..., 2:, :].reciprocal()


def _squared(x: Tensor) -> Tensor:
    # In place: these are the largest tensors there are, and belong to no graph.
    return x.square_().sum(dim=-2)

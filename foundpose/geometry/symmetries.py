"""Symmetries of objects: discrete ones and rotations about axes, with the angle that suits a pose best."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from foundpose.geometry.transforms import make_transform

# Published transformations are rounded to a few digits.
_RIGIDITY = 0.02


class Symmetries(NamedTuple):
    """Transformations ``T_model_from_model`` that leave the look of each of B objects unchanged.

    The set of an object is every discrete symmetry alone and every rotation about one axis after a discrete
    symmetry, ``C(angle) @ D``, as in BOP; rotations about two different axes are not combined. It should be a group
    (a pose error is otherwise not the same for all equivalent ground truths), which is not checked.

    Attributes:
        transforms: (B, S, 4, 4) discrete symmetries, the identity first; translations in mesh units.
        valid: (B, S) bool, which of them exist.
        axes: (B, A, 3) unit vectors, axes of continuous symmetries; A may be 0.
        origins: (B, A, 3) a point on each axis, mesh units.
        axis_valid: (B, A) bool, which axes exist.
    """

    transforms: Tensor
    valid: Tensor
    axes: Tensor
    origins: Tensor
    axis_valid: Tensor

    def gather(self, index: Tensor) -> Self:
        """Symmetries of the objects at ``index`` (N,), integers: a batch of N."""
        if index.dim() != 1 or index.is_floating_point() or index.dtype == torch.bool:
            raise ValueError(f"index must be (N,) integers, got {tuple(index.shape)} {index.dtype}")
        return type(self)(*(value[index] for value in self))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Move to a device; ``dtype`` applies to all but the masks."""
        return type(self)(
            *(value.to(device=device, dtype=dtype if value.is_floating_point() else None) for value in self)
        )

    def detach(self) -> Self:
        """The same symmetries as constants of autograd."""
        return type(self)(*(value.detach() for value in self))

    def check(self, batch: int, like: Tensor) -> None:
        """Check shapes, and that batch size, dtype and device are those of poses.

        Raises:
            ValueError: something disagrees.
        """
        S, A = (value.shape[1] if value.dim() > 1 else 0 for value in (self.transforms, self.axes))
        shapes = [(batch, S, 4, 4), (batch, S), (batch, A, 3), (batch, A, 3), (batch, A)]
        forms = ["(B, S, 4, 4)", "(B, S)", "(B, A, 3)", "(B, A, 3)", "(B, A)"]
        for name, value, shape, form in zip(self._fields, self, shapes, forms, strict=True):
            if value.shape != shape or S == 0:
                raise ValueError(
                    f"symmetries.{name} must have shape {form} with B = {batch} and S at least 1, got "
                    f"{tuple(value.shape)} (Symmetries.gather gives one entry for each pose)"
                )
            dtype = torch.bool if name.endswith("valid") else like.dtype
            if value.dtype != dtype or value.device != like.device:
                raise ValueError(
                    f"symmetries.{name} must be {dtype} on {like.device}, got {value.dtype} on {value.device} "
                    "(Symmetries.to converts)"
                )


def no_symmetries(
    batch: int, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> Symmetries:
    """Symmetries of objects that have none: the identity alone."""
    if batch < 0:
        raise ValueError(f"batch must not be negative, got {batch}")
    index = torch.zeros(batch, dtype=torch.int64)
    return symmetries_from_models_info({}).gather(index).to(device, dtype or torch.get_default_dtype())


def symmetries_from_models_info(entry: Mapping[str, Any]) -> Symmetries:
    """Symmetries of one object from its entry in BOP's ``models_info.json``.

    Args:
        entry: may hold ``symmetries_discrete``, a list of 4 × 4 matrices as 16 numbers row by row, and
            ``symmetries_continuous``, a list of ``{"axis": [x, y, z], "offset": [x, y, z]}``. Lengths are in the
            mesh's unit. Other keys are ignored.

    Returns:
        :class:`Symmetries` with B = 1, float64. Matrices are kept as published, axes are normalised.

    Raises:
        ValueError: an entry has the wrong size, is not finite, no rigid transformation, or an axis of length zero.
    """
    discrete = [torch.eye(4, dtype=torch.float64)]
    for i, values in enumerate(_list(entry, "symmetries_discrete")):
        T = _numbers(values, 16, f"symmetries_discrete[{i}]").reshape(4, 4)
        R = T[:3, :3]
        off = (R @ R.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
        if off > _RIGIDITY or torch.det(R).item() < 0 or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError(
                f"symmetries_discrete[{i}] must be a rigid transformation, row by row (a rotation, and 0 0 0 1 as "
                f"the last row), got {T.tolist()}"
            )
        discrete.append(T)
    axes, origins = [], []
    for i, axis in enumerate(_list(entry, "symmetries_continuous")):
        name = f"symmetries_continuous[{i}]"
        if not isinstance(axis, Mapping) or not {"axis", "offset"} <= axis.keys():
            raise ValueError(f'{name} must be {{"axis": [x, y, z], "offset": [x, y, z]}}, got {axis!r}')
        direction = _numbers(axis["axis"], 3, f"{name}.axis")
        length = torch.linalg.vector_norm(direction)
        if not length > 0:
            raise ValueError(f"{name}.axis must not be zero, got {direction.tolist()}")
        axes.append(direction / length)
        origins.append(_numbers(axis["offset"], 3, f"{name}.offset"))
    empty = torch.zeros(0, 3, dtype=torch.float64)
    return Symmetries(
        torch.stack(discrete)[None],
        torch.ones(1, len(discrete), dtype=torch.bool),
        (torch.stack(axes) if axes else empty)[None],
        (torch.stack(origins) if origins else empty)[None],
        torch.ones(1, len(axes), dtype=torch.bool),
    )


def _list(entry: Mapping[str, Any], key: str) -> list[Any]:
    value = entry.get(key, [])
    if not isinstance(value, list):
        raise ValueError(f"{key} must be a list, got {value!r}")
    return value


def _numbers(values: object, count: int, name: str) -> Tensor:
    try:
        numbers = torch.tensor(values, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be {count} numbers, got {values!r}") from error
    if numbers.shape != (count,) or not bool(torch.isfinite(numbers).all()):
        raise ValueError(f"{name} must be {count} finite numbers, got {values!r}")
    return numbers


def stack_symmetries(symmetries: Sequence[Symmetries]) -> Symmetries:
    """Join batches of symmetries into one, padded to the largest S and A with entries that are not valid.

    Raises:
        ValueError: ``symmetries`` is empty.
    """
    if not symmetries:
        raise ValueError("symmetries must hold at least one entry, got none")
    S = max(entry.transforms.shape[1] for entry in symmetries)
    A = max(entry.axes.shape[1] for entry in symmetries)
    padded = []
    for entry in symmetries:
        batch, count = entry.valid.shape
        more = A - entry.axes.shape[1]
        identities = torch.eye(4, dtype=entry.axes.dtype, device=entry.axes.device)
        # Padding is finite and rigid, so that whatever is computed with it is finite too.
        padded.append(
            Symmetries(
                torch.cat([entry.transforms, identities.expand(batch, S - count, 4, 4)], dim=1),
                torch.cat([entry.valid, entry.valid.new_zeros(batch, S - count)], dim=1),
                torch.cat([entry.axes, identities[2, :3].expand(batch, more, 3)], dim=1),
                torch.cat([entry.origins, entry.origins.new_zeros(batch, more, 3)], dim=1),
                torch.cat([entry.axis_valid, entry.axis_valid.new_zeros(batch, more)], dim=1),
            )
        )
    return Symmetries(*(torch.cat(values) for values in zip(*padded, strict=True)))


def axis_rotation(axes: Tensor, origins: Tensor, angles: Tensor) -> Tensor:
    """Rotations about lines in space.

    Args:
        axes: (..., 3) unit vectors.
        origins: (..., 3) a point on each line.
        angles: (...) radians, leading dimensions broadcast.

    Returns:
        (..., 4, 4) transformations; the identity to the last bit where the angle is 0.

    Differentiable w.r.t. all arguments.
    """
    x, y, z = axes.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    sine, half = angles.sin()[..., None, None], (0.5 * angles).sin()[..., None, None]
    # Rodrigues, with 1 - cos written so that small angles keep their digits.
    turn = sine * cross + 2.0 * half * half * (cross @ cross)
    R = torch.eye(3, dtype=axes.dtype, device=axes.device) + turn
    return make_transform(R, -(turn @ origins.unsqueeze(-1)).squeeze(-1))


def discretise(symmetries: Symmetries, step: float = 0.01) -> tuple[Tensor, Tensor]:
    """All symmetries as a finite set, the one that BOP's pose errors run over.

    Each axis is sampled at ``n = ceil(π / step)`` equal angles that start at 0 and go round once (so neighbours are
    2 ``step`` apart, and no angle is further than ``step`` from a sample), after each discrete symmetry.

    Args:
        symmetries: :class:`Symmetries` of B objects.
        step: radians; BOP uses 0.01, which gives 315 angles.

    Returns:
        ``T_model_from_model`` (B, S', 4, 4) and validity (B, S'), with S' = S (1 + A (n - 1)): for each discrete
        symmetry first itself, then the angles other than 0 of each axis. With at most one axis that is BOP's order;
        with several, BOP lists the angle 0 once for each.

    Raises:
        ValueError: ``step`` is not positive.

    Differentiable w.r.t. ``transforms``, ``axes`` and ``origins``.

    Source: Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", section 2.2; bop_toolkit's convention.
    """
    if not step > 0:
        raise ValueError(f"step must be positive, got {step}")
    count = math.ceil(math.pi / step)
    D, axes = symmetries.transforms, symmetries.axes
    angles = torch.arange(1, count, dtype=D.dtype, device=D.device) * (2.0 * math.pi / count)
    C = axis_rotation(axes[:, :, None], symmetries.origins[:, :, None], angles).flatten(1, 2)
    T = torch.cat([D[:, :, None], C[:, None] @ D[:, :, None]], dim=2).flatten(1, 2)
    after = torch.cat(
        [torch.ones_like(symmetries.valid[:, :1]), symmetries.axis_valid.repeat_interleave(count - 1, dim=1)],
        dim=1,
    )
    return T, (symmetries.valid[:, :, None] & after[:, None]).flatten(1, 2)


def nearest_axis_angles(
    T_est: Tensor, T_true: Tensor, symmetries: Symmetries, mean: Tensor, covariance: Tensor
) -> Tensor:
    """Angle about each axis, after each discrete symmetry, that brings the true pose nearest to the estimate.

    Minimises the mean squared distance between ``T_est x`` and ``T_true C(angle) D x`` over the model points x in
    closed form, exactly, whatever ``T_est`` is; ``T_true`` may be scaled but must keep right angles.

    Args:
        T_est: (B, 4, 4) estimated poses.
        T_true: (B, 4, 4) true poses.
        symmetries: :class:`Symmetries` of B objects.
        mean: (B, 3) or (1, 3) mean of the model points.
        covariance: (B, 3, 3) or (1, 3, 3) their covariance. A unit matrix, with all translations zero, gives the
            nearest rotation.

    Returns:
        (B, S, A) radians in [-π, π]; an angle that does not matter is 0.

    Differentiable w.r.t. all arguments except where the angle does not matter.
    """
    R_est, R_true = T_est[:, None, None, :3, :3], T_true[:, None, None, :3, :3]
    D = symmetries.transforms[:, :, None]
    axes, origins, mean = symmetries.axes[:, None], symmetries.origins[:, None], mean[:, None, None]
    # H = E[v wᵀ] with w = D x - origin, and v the estimated point seen from the true pose, less the origin.
    shift = (T_est - T_true)[:, None, None, :3, 3]
    v = _apply(R_true.mT, _apply(R_est, mean) + shift - _apply(R_true, origins))
    w = _apply(D[..., :3, :3], mean) + D[..., :3, 3] - origins
    H = R_true.mT @ R_est @ covariance[:, None, None] @ D[..., :3, :3].mT + v.unsqueeze(-1) * w.unsqueeze(-2)
    along = (axes * _apply(H, axes)).sum(-1)
    cosine = H.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    curl = torch.stack(
        [H[..., 2, 1] - H[..., 1, 2], H[..., 0, 2] - H[..., 2, 0], H[..., 1, 0] - H[..., 0, 1]], dim=-1
    )
    return torch.atan2((axes * curl).sum(-1), cosine)


def _apply(R: Tensor, x: Tensor) -> Tensor:
    return (R @ x.unsqueeze(-1)).squeeze(-1)

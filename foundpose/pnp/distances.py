"""The distances of three points along three rays, from the sides of their triangle, all samples at once.

With distances d₁, d₂ = d₁ (1 + ε X) and d₃ = d₁ (1 + ε Y) along unit rays whose chords are ε √C, the law of cosines
for the three sides of the triangle reads, with σ = (ε d₁)²,

    σ (X² + (1 + ε X) C₁₂) = D₁₂,   σ (Y² + (1 + ε Y) C₁₃) = D₁₃,   σ ((X − Y)² + (1 + ε X)(1 + ε Y) C₂₃) = D₂₃.

Every number here is of order one however narrow the field of view is (ε → 0 is weak perspective), so float32 loses
no digits to cosines near one or to distances that nearly agree. Without σ these are two conics in (X, Y). A member
of their pencil that is a pair of lines comes from one root of a cubic; each line meets the conics in two points.

The samples are the last dimension and sums are written out: contiguous memory, and no rounding that depends on the
number of samples.
"""

import torch
from torch import Tensor

_CUBIC_STEPS, _POLISH_STEPS = 5, 2
_Tensors = tuple[Tensor, ...]


def solve_distances(C: Tensor, D: Tensor, epsilon: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All distances that the law of cosines allows.

    Args:
        C: (3 pairs, S) squared chords, divided by their sum ε².
        D: (3 pairs, S) squared sides of the triangle.
        epsilon: (S,) the constant ε.

    Returns:
        X, Y and σ (4, S) of four candidates, and which of them are real and in front of the camera (4, S). Roots
        have the gradient of the equations to C and D (first derivatives).

    Source: as of :func:`~foundpose.pnp.p3p.solve_p3p_rays`.
    """
    fixed = C.detach().unbind(0), D.detach().unbind(0), epsilon
    X, Y, sigma, candidate = _polish(*_intersect_conics(*fixed), *fixed)
    if C.requires_grad or D.requires_grad:
        X, Y, sigma = _attach_gradient(X, Y, sigma, C, D, epsilon)
    return X, Y, sigma, candidate


def _intersect_conics(C: _Tensors, D: _Tensors, epsilon: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates X and Y (4, S), finite, and which of them are real."""
    eps, tiny = torch.finfo(epsilon.dtype).eps, torch.finfo(epsilon.dtype).tiny ** 0.5
    pencil = _pencil(C, D, epsilon)
    # det(α A + β B) = ⅓ T_AA α³ + T_AB α² β + T_BA α β² + ⅓ T_BB β³ with T_PQ = tr(adj(P) Q). Name the conics so
    # that the last coefficient is the larger of the outer ones, and take α = 1.
    diagonal, off = (_adjugate(pencil).unsqueeze(3) * pencil[:, :3].unsqueeze(2)).unbind(0)
    traces = total(diagonal + 2.0 * off)  # (2, 2, S)
    swap = traces[0, 0].abs() > traces[1, 1].abs()
    traces = torch.where(swap, traces.flip(0, 1), traces)
    (last, linear), (quadratic, lead) = (row.unbind(0) for row in traces.unbind(0))
    lead = _away_from_zero(lead, eps * (quadratic.abs() + linear.abs()) + tiny)
    beta = _isolated_root(quadratic / lead, linear / lead, last / lead)
    A, B = torch.where(swap, pencil.flip(2), pencil).unbind(2)
    alpha = 1.0 / (1.0 + beta * beta).sqrt()
    beta = alpha * beta
    # Cut the lines with the conic farthest from them in the pencil. A point of a line is foot + τ direction.
    lines, crossing = _split_lines(alpha * A + beta * B, tiny)
    (q00, q11, q22), (q12, q02, q01) = (part.unbind(0) for part in (alpha * B - beta * A)[:, :3].unbind(0))
    l0, l1, l2 = lines.unbind(0)  # (2 lines, S)
    inverse = 1.0 / (l1 * l1 + l2 * l2).clamp(min=tiny).sqrt()
    l0, l1, l2 = -l0 * inverse, l1 * inverse, l2 * inverse
    x, y = l0 * l1, l0 * l2
    slope_x, slope_y = q11 * x + q12 * y + q01, q12 * x + q22 * y + q02
    a = (q11 * l2 - q12 * l1) * l2 + (q22 * l1 - q12 * l2) * l1
    b = slope_x * l2 - slope_y * l1
    c = (slope_x + q01) * x + (slope_y + q02) * y + q00
    discriminant = b * b - a * c
    # Rounding may turn a double root into none; what is let through here must still fit the rays.
    real = crossing & (discriminant >= -(eps**0.5) * (1.0 + b * b))
    root = discriminant.clamp(min=0.0).sqrt()
    outer = -(b + torch.where(b < 0, -root, root))
    limit = eps**-0.5
    tau = (torch.stack([outer, c]) / _away_from_zero(torch.stack([a, outer]), tiny)).clamp(-limit, limit)
    X, Y = (x + tau * l2).flatten(0, 1), (y - tau * l1).flatten(0, 1)
    return X.clamp(-limit, limit), Y.clamp(-limit, limit), real.repeat(2, 1)


def _pencil(C: _Tensors, D: _Tensors, epsilon: Tensor) -> Tensor:
    """Two conics through the solutions: (2, 5, 2 conics, S), in the layout of :func:`_adjugate`."""
    # Combinations of the equations orthogonal to D, by its reflection onto an axis: well conditioned for any D.
    inverse = 1.0 / (D[0] * D[0] + D[1] * D[1] + D[2] * D[2]).sqrt()
    w = torch.stack([D[0] * inverse, D[1] * inverse])
    h = w / (1.0 + D[2] * inverse)
    cross = -w[0] * h[1]
    v1, v2 = torch.stack([1.0 - w[0] * h[0], cross]), torch.stack([cross, 1.0 - w[1] * h[1]])
    half = 0.5 * epsilon
    first, second, third = v1 * C[0], v2 * C[1], -w * C[2]
    half_third = half * third
    d = [first + second + third, v1 - w, v2 - w]
    o = [epsilon * half_third + w, half * second + half_third, half * first + half_third]
    return torch.stack([*d, *d[:2], *o, *o[:2]]).unflatten(0, (2, 5))


def _isolated_root(b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """The real root of g³ + 3 b g² + 3 c g + d farthest from the mean of all three: never one of a close pair."""
    p = c - b * b
    q = d - b * (c + 2.0 * p)
    r, p3 = q.abs(), 3.0 * p
    tiny = torch.finfo(b.dtype).tiny
    # t³ + 3 p t = r has one positive root, and Newton's method comes down to it without overshooting from its
    # second step on. Start from r to the power 21/64: nearly a cube root, and the same to the last bit everywhere.
    fourth = r.sqrt().sqrt()
    sixteenth = fourth.sqrt().sqrt()
    cube_root = fourth * sixteenth * sixteenth.sqrt().sqrt()
    upper = torch.minimum(cube_root, r / p3.clamp(min=tiny))
    t = torch.where(p > 0, upper, torch.maximum(cube_root, (-p3).clamp(min=0.0).sqrt()))
    for _ in range(_CUBIC_STEPS):
        square = t * t
        t = (2.0 * square * t + r) / (3.0 * square + p3).clamp(min=tiny)
    return torch.where(q > 0, -t, t) - b


def _split_lines(pair: Tensor, tiny: float) -> tuple[Tensor, Tensor]:
    """The two lines (3, 2, S) of degenerate conics (2, 5, S), and whether they are real (S,)."""
    # Up to rounding the negative adjugate is p pᵀ, with p half the cross product of the lines.
    diagonal, off = (-_adjugate(pair)).unbind(0)
    (m00, m11, m22), (m12, m02, m01) = diagonal.unbind(0), off.unbind(0)
    largest, column = diagonal.max(dim=0)
    matrix = torch.stack([m00, m01, m02, m01, m11, m12, m02, m12, m22]).unflatten(0, (3, 3))
    p0, p1, p2 = (_pick(matrix, column) / largest.clamp(min=tiny).sqrt()).unbind(0)
    (c00, c11, c22), (c12, c02, c01) = (part.unbind(0) for part in pair[:, :3].unbind(0))
    product = torch.stack([c00, c01 - p2, c02 + p1, c01 + p2, c11, c12 - p0, c02 - p1, c12 + p0, c22])
    product = product.unflatten(0, (3, 3))  # of the lines: each row is the one, each column the other
    magnitude = product.abs()
    # max, as argmax takes a CPU twenty times as long.
    row = _pick(product, magnitude.amax(1).max(dim=0).indices)
    column = _pick(product.transpose(0, 1), magnitude.amax(0).max(dim=0).indices)
    return torch.stack([row, column], dim=1), largest > 0


def _polish(X: Tensor, Y: Tensor, real: Tensor, C: _Tensors, D: _Tensors, epsilon: Tensor) -> _Tensors:
    """Newton's method on the three equations: X, Y and σ (4, S), and which are real and in front of the camera."""
    per_total = 0.5 / (D[0] + D[1] + D[2])
    for _ in range(_POLISH_STEPS):
        f, half_slopes = _equations(X, Y, C, epsilon)
        _, dX, dY = _solve(f, half_slopes, D)
        by_sigma = (f[0] + f[1] + f[2]) * per_total
        X, Y = X + (dX * by_sigma).clamp(-1.0, 1.0), Y + (dY * by_sigma).clamp(-1.0, 1.0)
    candidate = real & (epsilon * torch.minimum(X, Y) > torch.finfo(X.dtype).eps - 1.0)
    # Three equal distances stand in for the others.
    X, Y = X.masked_fill(~candidate, 0.0), Y.masked_fill(~candidate, 0.0)
    f, _ = _equations(X, Y, C, epsilon)
    return X, Y, 0.5 / ((f[0] + f[1] + f[2]) * per_total), candidate


def _attach_gradient(X: Tensor, Y: Tensor, sigma: Tensor, C: Tensor, D: Tensor, epsilon: Tensor) -> _Tensors:
    """X, Y and σ with their values unchanged and with gradients to C and D by the implicit function theorem."""
    f, half_slopes = _equations(X, Y, C.detach().unbind(0), epsilon)
    a, b = 1.0 + epsilon * X, 1.0 + epsilon * Y
    dC, dD = (C - C.detach()).unbind(0), (D - D.detach()).unbind(0)  # zero, but for their gradients
    r = (dD[0] - sigma * a * dC[0], dD[1] - sigma * b * dC[1], dD[2] - sigma * a * b * dC[2])
    d_sigma, dX, dY = _solve(f, half_slopes, r)
    return X + dX * (0.5 / sigma), Y + dY * (0.5 / sigma), sigma + d_sigma


def _equations(X: Tensor, Y: Tensor, C: _Tensors, epsilon: Tensor) -> tuple[_Tensors, _Tensors]:
    """The brackets of the three equations (see the module), and half their slopes: ∂₁/∂X, ∂₂/∂Y, ∂₃/∂X, ∂₃/∂Y."""
    a, b, difference = 1.0 + epsilon * X, 1.0 + epsilon * Y, X - Y
    half = 0.5 * epsilon
    b_C = b * C[2]
    f = (X * X + a * C[0], Y * Y + b * C[1], difference * difference + a * b_C)
    half_slopes = (X + half * C[0], Y + half * C[1], difference + half * b_C, half * C[2] * a - difference)
    return f, half_slopes


def _solve(f: _Tensors, slopes: _Tensors, r: _Tensors) -> tuple[Tensor, Tensor, Tensor]:
    """Solve s f_i + (slopes of i)·(x, y) = r_i by Cramer's rule, damped near a double root, where steps are noise."""
    f1x, f2y, f3x, f3y = slopes
    x_part, y_part = f2y * f3x, f1x * f3y
    diagonal = f1x * f2y
    determinant = f[2] * diagonal - f[0] * x_part - f[1] * y_part
    inverse = determinant / (determinant * determinant + torch.finfo(determinant.dtype).eps ** (4.0 / 3.0))
    r12, r13, r23 = r[0] * f[1] - r[1] * f[0], r[0] * f[2] - r[2] * f[0], r[1] * f[2] - r[2] * f[1]
    scale = (r[2] * diagonal - r[0] * x_part - r[1] * y_part) * inverse
    return scale, (f2y * r13 - f3y * r12) * inverse, (f3x * r12 + f1x * r23) * inverse


def _adjugate(m: Tensor) -> Tensor:
    """Adjugates (2, 3, ...) of symmetric matrices (2, 5, ...), stored as the diagonal 00, 11, 22 and the entries
    opposite to it, 12, 02, 01; what goes in repeats the first two of each behind the third."""
    return m[:, 1:4] * m[:, 2:5] - m[:, :3].flip(0) * m[1, :3]


def total(x: Tensor) -> Tensor:
    """Sum over dimension 0, of size 3."""
    a, b, c = x.unbind(0)
    return a + b + c


def _pick(matrix: Tensor, row: Tensor) -> Tensor:
    """One row per sample: (3, 3, S) and (S,) → (3, S)."""
    return matrix.gather(0, row.expand(1, 3, -1)).squeeze(0)


def _away_from_zero(x: Tensor, smallest: Tensor | float) -> Tensor:
    return torch.where(x.abs() < smallest, smallest, x)

import math

import cv2
import pytest
import torch

from foundpose.geometry.similarity import (
    apply_similarity,
    check_in_plane,
    fit_similarity,
    fit_similarity_robustly,
)


def moved(angle: float, scale: float, shift: tuple[float, float], count: int = 40):
    g = torch.Generator().manual_seed(1)
    x = torch.rand(count, 2, generator=g, dtype=torch.float64) * 30
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    A = torch.tensor([[c, -s, shift[0]], [s, c, shift[1]]], dtype=torch.float64)
    return x, apply_similarity(A, x), A


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.5])
@pytest.mark.parametrize("scale", [0.7, 1.0, 1.6])
def test_finds_the_motion(angle, scale):
    x, y, A = moved(angle, scale, (3.0, -5.0))
    torch.testing.assert_close(fit_similarity(x, y, torch.ones(40).double()), A, atol=1e-9, rtol=0)


def test_weighted_fit_equals_least_squares():
    g = torch.Generator().manual_seed(2)
    x, y, _ = moved(0.3, 1.2, (1.0, 2.0))
    y = y + torch.randn(40, 2, generator=g, dtype=torch.float64)
    w = torch.rand(40, generator=g, dtype=torch.float64)
    # target = [a -b; b a] source + t is linear in (a, b, t).
    one, zero = torch.ones(40).double(), torch.zeros(40).double()
    rows = torch.cat(
        [
            torch.stack([x[:, 0], -x[:, 1], one, zero], 1),
            torch.stack([x[:, 1], x[:, 0], zero, one], 1),
        ]
    )
    root = w.sqrt().repeat(2)[:, None]
    a, b, u, v = torch.linalg.lstsq(rows * root, (y.T.reshape(-1, 1)) * root).solution[:, 0]
    expected = torch.stack([torch.stack([a, -b, u]), torch.stack([b, a, v])])
    torch.testing.assert_close(fit_similarity(x, y, w), expected, atol=1e-9, rtol=0)


def test_robust_fit_ignores_wrong_pairs_as_opencv_does():
    x, y, A = moved(0.2, 1.1, (2.0, 1.0), 100)
    g = torch.Generator().manual_seed(3)
    wrong = torch.rand(100, generator=g) < 0.35
    y = torch.where(wrong[:, None], torch.rand(100, 2, generator=g, dtype=torch.float64) * 30, y)
    found = fit_similarity_robustly(x, y, torch.ones(100).double(), (6.0, 3.0, 1.5, 0.5, 0.2, 0.1))
    reference, _ = cv2.estimateAffinePartial2D(x.numpy(), y.numpy(), ransacReprojThreshold=0.1)
    torch.testing.assert_close(torch.from_numpy(reference), A, atol=1e-6, rtol=0)
    torch.testing.assert_close(found, A, atol=0.05, rtol=0)


@pytest.mark.parametrize(("motion", "free"), [("shift", (False, False)), ("scale", (True, False))])
def test_only_what_may_change_changes(motion, free):
    x, y, _ = moved(0.3, 1.4, (1.0, 2.0))
    A = fit_similarity(x, y, torch.ones(40).double(), motion)
    assert (A[0, 0] != 1.0) == free[0]
    assert (A[1, 0] != 0.0) == free[1]


def test_scale_is_bounded_and_nothing_gives_the_identity():
    x, y, _ = moved(0.0, 5.0, (0.0, 0.0))
    A = fit_similarity(x, y, torch.ones(40).double())
    torch.testing.assert_close(torch.linalg.vector_norm(A[:, 0]), torch.tensor(2.0).double())
    nothing = fit_similarity(x, y, torch.zeros(40).double())
    assert torch.equal(nothing[:, :2], torch.eye(2).double())
    assert nothing.isfinite().all()
    one = fit_similarity(x, y, torch.eye(40)[3].double())
    torch.testing.assert_close(apply_similarity(one, x)[3], y[3])


def test_gradient():
    x, y, _ = moved(0.3, 1.2, (1.0, 2.0), 6)
    w = torch.rand(6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inputs = [t.clone().requires_grad_() for t in (x, y, w)]
    assert torch.autograd.gradcheck(fit_similarity, inputs)


def test_unknown_motion():
    with pytest.raises(ValueError, match="got 'affine'"):
        check_in_plane("affine")

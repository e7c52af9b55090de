import numpy as np
import pytest
import torch
from torch import Tensor

from foundpose.matching import Matches, PatchMatcher, SoftPatchMatcher
from tests.matching.test_matcher import assert_same, problem, records


def brute_force(inputs: tuple[Tensor, ...], temperature: float) -> tuple[np.ndarray, np.ndarray]:
    """Expected points and confidences, one patch at a time."""
    query, query_valid, template, template_valid, _, points = (t.numpy() for t in inputs)
    B, h, _, _ = template.shape
    P = query.shape[1]
    expected, weight = np.zeros((B, h, P, 3)), np.zeros((B, h, P))
    for b, t in np.ndindex(B, h):
        columns = np.flatnonzero(template_valid[b, t])
        if len(columns) == 0:
            continue
        X = points[b, t, columns]
        spacing = 2 * np.pi * ((X - X.mean(0)) ** 2).sum(1).mean() / len(X)
        for i in np.flatnonzero(query_valid[b]):
            squared = ((query[b, i] - template[b, t, columns]) ** 2).sum(1)
            p = np.exp(-(squared - squared.min()) / (2 * temperature**2))
            p /= p.sum()
            expected[b, t, i] = p @ X
            variance = p @ ((X - p @ X) ** 2).sum(1)
            weight[b, t, i] = spacing / (spacing + variance)
    return expected, weight


@pytest.mark.parametrize("temperature", [0.3, 1.0, 5.0])
def test_equals_brute_force(temperature: float) -> None:
    inputs = problem()
    inputs[1][1] = False  # a crop without patches
    inputs[3][2, 1] = False  # a template without patches
    got = SoftPatchMatcher(temperature).double()(*records(*inputs))
    expected, weight = brute_force(inputs, temperature)
    torch.testing.assert_close(got.points_model, torch.from_numpy(expected), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(got.weight, torch.from_numpy(weight), rtol=1e-5, atol=1e-6)
    hard = PatchMatcher()(*records(*inputs))
    assert torch.equal(got.valid, hard.valid)
    assert torch.equal(got.template_patch, hard.template_patch)
    torch.testing.assert_close(got.distance, hard.distance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tends_to_the_nearest_matcher(dtype: torch.dtype) -> None:
    inputs = tuple(t.to(dtype) if t.is_floating_point() else t for t in problem())
    hard = PatchMatcher()(*records(*inputs))
    errors = []
    for temperature in (1.0, 0.3, 0.1, 0.03):
        soft = SoftPatchMatcher(temperature)(*records(*inputs))
        errors.append((soft.points_model - hard.points_model).norm(dim=-1).mean().item())
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.05 * errors[0]
    for temperature in (1e-4, 1e-18):
        assert_same(SoftPatchMatcher(temperature)(*records(*inputs)), hard)


def test_confidence_of_hard_matches_is_that_of_the_soft_ones_at_their_points() -> None:
    inputs = problem()
    hard = PatchMatcher(confidence_temperature=0.5)(*records(*inputs))
    soft = SoftPatchMatcher(0.5).double()(*records(*inputs))
    # The mean squared distance is smallest about the expected point.
    valid = hard.valid
    assert (hard.weight[valid] <= soft.weight[valid] + 1e-7).all()
    assert (hard.weight[valid] > 0).all()
    sure = PatchMatcher(confidence_temperature=1e-4)(*records(*inputs))
    torch.testing.assert_close(sure.weight, valid.double(), atol=1e-9, rtol=0)
    # It changes nothing else.
    assert_same(hard._replace(weight=valid.double()), PatchMatcher()(*records(*inputs)))


def test_gradcheck() -> None:
    query, query_valid, template, template_valid, pixels, points = problem(B=1, h=2, P=4, Q=5, d=3)
    query_valid[0, 1] = False
    matcher = SoftPatchMatcher(1.0, learnable=True).double()

    def run(q: Tensor, t: Tensor, x: Tensor, log_temperature: Tensor) -> tuple[Tensor, ...]:
        def call(x: Tensor) -> Matches:
            values = {"log_temperature": log_temperature}
            inputs = (q, query_valid, t, template_valid, pixels, x)
            return torch.func.functional_call(matcher, values, records(*inputs))

        # The spacing of the patches, part of the confidence, counts as constant.
        matches = call(x)
        return matches.points_model, call(points).weight, matches.distance[matches.valid]

    leaves = [x.detach().clone().requires_grad_() for x in (query, template, points, matcher.log_temperature)]
    assert torch.autograd.gradcheck(run, leaves)


def test_gradients_stay_finite_and_at_home() -> None:
    query, query_valid, template, template_valid, pixels, points = problem()
    query_valid[0], template_valid[1] = False, False
    template[2, 0, 0] = query[2, 0]  # a distance of zero
    leaves = [x.requires_grad_() for x in (query, template, points)]
    for temperature in (1e-6, 1.0, 1e6):
        matches = SoftPatchMatcher(temperature)(
            *records(query, query_valid, template, template_valid, pixels, points)
        )
        value = matches.points_model.square().sum() + matches.weight.sum()
        gradients = torch.autograd.grad(value + matches.distance[matches.valid].sum(), leaves)
        assert all(torch.isfinite(g).all() for g in gradients)
        assert (gradients[0][0] == 0).all()
        assert (gradients[1][1] == 0).all()
        assert (gradients[2][1] == 0).all()
        assert (gradients[1][~template_valid] == 0).all()
        assert (gradients[0][~query_valid] == 0).all()


def test_what_stands_outside_the_masks_does_not_matter() -> None:
    query, query_valid, template, template_valid, pixels, points = problem()
    matcher = SoftPatchMatcher(0.7)
    expected = matcher(*records(query, query_valid, template, template_valid, pixels, points))
    got = matcher(
        *records(
            query.masked_fill(~query_valid[..., None], torch.nan),
            query_valid,
            template.masked_fill(~template_valid[..., None], torch.inf),
            template_valid,
            pixels,
            points.masked_fill(~template_valid[..., None], torch.nan),
        ),
    )
    for one, other in zip(got, expected, strict=True):
        assert torch.equal(one, other)


def test_alone_as_in_a_batch() -> None:
    inputs = problem()
    matcher = SoftPatchMatcher(0.7)
    together = matcher(*records(*inputs))
    for b in range(3):
        assert_same(
            matcher(*records(*(x[b : b + 1] for x in inputs))), Matches(*(x[b : b + 1] for x in together))
        )


def test_far_from_the_origin_in_float32() -> None:
    inputs = [x.float() if x.is_floating_point() else x for x in problem()]
    near = SoftPatchMatcher(0.2)(*records(*inputs))
    inputs[5] = inputs[5] + 5000.0
    far = SoftPatchMatcher(0.2)(*records(*inputs))
    torch.testing.assert_close(near.weight, far.weight, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("empty", [{"B": 0}, {"h": 0}, {"P": 0}, {"Q": 0}])
def test_empty_dimensions(empty: dict[str, int]) -> None:
    inputs = problem(**empty)
    got = SoftPatchMatcher(1.0)(*records(*inputs))
    assert all(t.shape[:3] == (*inputs[2].shape[:2], inputs[0].shape[1]) for t in got)
    assert not got.valid.any()
    assert torch.isfinite(got.points_model).all()


def test_learnable_temperature_and_bad_arguments() -> None:
    assert not list(SoftPatchMatcher(2.0).parameters())
    matcher = SoftPatchMatcher(2.0, learnable=True)
    assert float(matcher.temperature.detach()) == pytest.approx(2.0)
    matches = matcher(*records(*(x.float() if x.is_floating_point() else x for x in problem())))
    matches.weight.sum().backward()
    assert matcher.log_temperature.grad.abs() > 0
    assert "temperature=2, learnable=True" in repr(matcher)
    for bad in (0.0, -1.0, float("inf")):
        with pytest.raises(ValueError, match="temperature must be positive"):
            SoftPatchMatcher(bad)

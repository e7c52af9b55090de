import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

import foundpose.matching.base as base
from foundpose.matching.base import Matches
from foundpose.matching.matcher import PatchMatcher, keep_best
from foundpose.representation import TemplatePatches
from foundpose.retrieval import QueryPatches

Problem = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def problem(B: int = 3, h: int = 4, P: int = 30, Q: int = 25, d: int = 5, seed: int = 0) -> Problem:
    """Random float64 descriptors with ragged masks; pixels on a grid of 14 px; points in a box of 100."""
    g = torch.Generator().manual_seed(seed)
    query = torch.randn(B, P, d, generator=g, dtype=torch.float64)
    template = torch.randn(B, h, Q, d, generator=g, dtype=torch.float64)
    query_valid = torch.rand(B, P, generator=g) < 0.8
    template_valid = torch.rand(B, h, Q, generator=g) < 0.7
    cell = torch.arange(P, dtype=torch.float64)
    pixels = (torch.stack([cell % 6, cell // 6], dim=-1) * 14 + 6.5).expand(B, P, 2)
    points = torch.rand(B, h, Q, 3, generator=g, dtype=torch.float64) * 100 - 20
    return query, query_valid, template, template_valid, pixels, points


def records(
    query: Tensor,
    query_valid: Tensor,
    template: Tensor,
    template_valid: Tensor,
    pixels: Tensor,
    points: Tensor,
) -> tuple[QueryPatches, TemplatePatches]:
    """The two sides; nothing looks at the pixels of the templates."""
    unseen = torch.full((*template_valid.shape, 2), torch.nan)
    return QueryPatches(query, pixels, query_valid), TemplatePatches(template, points, unseen, template_valid)


def brute_force(inputs: Problem, cyclic: bool, top_k: int | None) -> Matches:
    query, query_valid, template, template_valid, pixels, points = (t.numpy() for t in inputs)
    B, h, _, _ = template.shape
    P = query.shape[1]
    index, distance = np.zeros((B, h, P), dtype=int), np.full((B, h, P), np.inf)
    matched, priority = np.zeros((B, h, P, 3)), np.full((B, h, P), -np.inf)
    for b in range(B):
        for t in range(h):
            rows, columns = np.flatnonzero(query_valid[b]), np.flatnonzero(template_valid[b, t])
            if len(rows) == 0 or len(columns) == 0:
                continue
            D = np.linalg.norm(query[b, rows][:, None] - template[b, t, columns][None], axis=-1)
            forth = D.argmin(1)
            back = D.argmin(0)[forth]
            cycle = np.linalg.norm(pixels[b, rows] - pixels[b, rows[back]], axis=-1)
            best = D[np.arange(len(rows)), forth]
            kept = sorted(range(len(rows)), key=lambda i: (cycle[i] * cyclic, best[i], i))[:top_k]
            priority[b, t, rows[kept]] = -cycle[kept] - (rows[kept] * 0.6180339887498949) % 1.0
            index[b, t, rows[kept]] = columns[forth[kept]]
            distance[b, t, rows[kept]] = best[kept]
            matched[b, t, rows[kept]] = points[b, t, columns[forth[kept]]]
    valid = np.isfinite(distance)
    fields = (index, distance, valid, matched, valid.astype(float), priority)
    return Matches(*(torch.from_numpy(x) for x in fields))


def assert_same(got: Matches, expected: Matches) -> None:
    assert torch.equal(got.valid, expected.valid)
    assert torch.equal(got.template_patch, expected.template_patch)
    for name in ("distance", "points_model", "weight"):
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), check_dtype=False, msg=name)


@pytest.mark.parametrize("mode", ["nearest", "cyclic"])
@pytest.mark.parametrize("top_k", [None, 1, 10, 1000])
def test_equals_brute_force(mode: str, top_k: int | None) -> None:
    inputs = problem()
    inputs[1][1] = False  # a crop without patches
    inputs[3][2, 1] = False  # a template without patches
    got = PatchMatcher(mode, top_k)(*records(*inputs))
    expected = brute_force(inputs, mode == "cyclic", top_k)
    assert_same(got, expected)
    torch.testing.assert_close(got.priority, expected.priority)
    assert not got.valid[1].any()
    assert not got.valid[2, 1].any()


def test_equals_sklearn() -> None:
    query, _, template, _, pixels, points = problem(B=1, h=1, P=200, Q=300, d=16)
    all_of = torch.ones(1, 200, dtype=torch.bool), torch.ones(1, 1, 300, dtype=torch.bool)
    got = PatchMatcher()(*records(query, all_of[0], template, all_of[1], pixels, points))
    distance, index = NearestNeighbors(n_neighbors=1).fit(template[0, 0].numpy()).kneighbors(query[0].numpy())
    assert torch.equal(got.template_patch[0, 0], torch.from_numpy(index[:, 0]))
    torch.testing.assert_close(got.distance[0, 0], torch.from_numpy(distance[:, 0]))


def test_patches_find_themselves_in_float32() -> None:
    query, valid, _, _, pixels, _ = problem(P=60, d=32)
    points = torch.rand(3, 1, 60, 3)
    query = (40 + query).float()
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    template = query[:, None, order]
    for mode in ("nearest", "cyclic"):
        got = PatchMatcher(mode)(
            *records(query, valid, template, valid[:, None, order], pixels.float(), points)
        )
        assert torch.equal(order[got.template_patch[:, 0]][valid], torch.arange(60).expand(3, 60)[valid])
        # Distances come from differences: exactly 0 although |q| is about 200.
        assert (got.distance[:, 0][valid] == 0).all()


def test_ties_go_to_the_lowest_index() -> None:
    query, template = torch.zeros(1, 4, 2), torch.zeros(1, 1, 5, 2)
    query_valid = torch.tensor([[False, True, True, True]])
    template_valid = torch.tensor([[[False, False, True, True, True]]])
    pixels = torch.tensor([[[0.0, 0], [14, 0], [28, 0], [42, 0]]])
    points = torch.zeros(1, 1, 5, 3)
    got = PatchMatcher("cyclic", top_k=2)(
        *records(query, query_valid, template, template_valid, pixels, points)
    )
    # All match template patch 2, which returns to patch 1: cycle distances 0, 14, 28.
    assert got.template_patch.tolist() == [[[0, 2, 2, 0]]]
    assert got.valid.tolist() == [[[False, True, True, False]]]


def test_keep_best_is_lexicographic() -> None:
    cycle = torch.tensor([14.0, 0.0, 0.0, 0.0, 0.0, 14.0])
    distance = torch.tensor([0.1, 0.5, 0.4, 0.5, 0.1, 0.0])
    valid = torch.tensor([True, True, True, True, False, True])
    kept = [keep_best(valid, cycle, distance, k).nonzero()[:, 0].tolist() for k in range(1, 7)]
    assert kept == [[2], [1, 2], [1, 2, 3], [1, 2, 3, 5], [0, 1, 2, 3, 5], [0, 1, 2, 3, 5]]
    assert keep_best(valid, None, distance, 2).nonzero()[:, 0].tolist() == [0, 5]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    mode=st.sampled_from(["nearest", "cyclic"]),
    top_k=st.sampled_from([None, 3, 12]),
)
def test_padding_and_batch_do_not_matter(seed: int, mode: str, top_k: int | None) -> None:
    query, query_valid, template, template_valid, pixels, points = problem(seed=seed)
    matcher = PatchMatcher(mode, top_k, confidence_temperature=0.8)
    expected = matcher(*records(query, query_valid, template, template_valid, pixels, points))
    far = 1e9
    padded = matcher(
        *records(
            torch.nn.functional.pad(query.masked_fill(~query_valid[..., None], far), (0, 0, 0, 9), value=far),
            torch.nn.functional.pad(query_valid, (0, 9)),
            torch.nn.functional.pad(
                template.masked_fill(~template_valid[..., None], far), (0, 0, 0, 6), value=far
            ),
            torch.nn.functional.pad(template_valid, (0, 6)),
            torch.nn.functional.pad(pixels, (0, 0, 0, 9)),
            torch.nn.functional.pad(
                points.masked_fill(~template_valid[..., None], far), (0, 0, 0, 6), value=far
            ),
        ),
    )
    assert not padded.valid[..., 30:].any()
    assert_same(Matches(*(t[:, :, :30] for t in padded)), expected)
    last = (slice(2, None), slice(3, None))
    alone = matcher(
        *records(query[2:], query_valid[2:], template[last], template_valid[last], pixels[2:], points[last])
    )
    assert_same(alone, Matches(*(t[last] for t in expected)))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), top_k=st.integers(1, 30))
def test_top_k_grows_by_inclusion(seed: int, top_k: int) -> None:
    inputs = problem(seed=seed)
    smaller, larger = (
        PatchMatcher("cyclic", top_k)(*records(*inputs)),
        PatchMatcher("cyclic", top_k + 1)(*records(*inputs)),
    )
    assert (larger.valid | ~smaller.valid).all()
    assert torch.equal(smaller.valid.sum(-1), larger.valid.sum(-1).clamp(max=top_k))


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = problem()
    expected = PatchMatcher("cyclic", 10)(*records(*inputs))
    monkeypatch.setattr(base, "_DISTANCES_PER_BLOCK", 30 * 25 * 5)
    assert_same(PatchMatcher("cyclic", 10)(*records(*inputs)), expected)


def test_gradcheck() -> None:
    query, query_valid, template, template_valid, pixels, points = problem(B=1, h=2, P=4, Q=5, d=3)
    matcher = PatchMatcher("cyclic", 3, confidence_temperature=1.5)

    def run(q: Tensor, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        matches = matcher(*records(q, query_valid, t, template_valid, pixels, x))
        # The spacing of the patches, part of the confidence, counts as constant.
        weight = matcher(*records(q, query_valid, t, template_valid, pixels, points)).weight
        return matches.distance[matches.valid], weight, matches.points_model

    assert torch.autograd.gradcheck(run, [x.clone().requires_grad_() for x in (query, template, points)])


def test_gradient_is_finite_at_zero_distance_and_for_invalid() -> None:
    query, query_valid, _, _, pixels, points = problem(B=2, h=1, Q=30)
    query.requires_grad_()
    template = query.detach()[:, None].clone().requires_grad_()
    matcher = PatchMatcher(confidence_temperature=1e-3)
    matches = matcher(*records(query, query_valid, template, query_valid[:, None], pixels, points))
    (matches.distance[matches.valid].sum() + matches.weight.sum()).backward()
    for leaf in (query, template):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()


@pytest.mark.parametrize("empty", [{"B": 0}, {"h": 0}, {"P": 0}, {"Q": 0}])
def test_empty_dimensions(empty: dict[str, int]) -> None:
    inputs = problem(**empty)
    got = PatchMatcher("cyclic", 5)(*records(*inputs))
    assert all(t.shape[:3] == (*inputs[2].shape[:2], inputs[0].shape[1]) for t in got)
    assert not got.valid.any()
    assert got.template_patch.dtype == torch.int64


def test_bad_input() -> None:
    query, query_valid, template, template_valid, pixels, points = problem()
    matcher = PatchMatcher()
    with pytest.raises(ValueError, match=r"got \(3, 30, 5\) and \(3, 4, 25, 4\)"):
        matcher(*records(query, query_valid, template[..., :4], template_valid, pixels, points))
    with pytest.raises(ValueError, match=r"got \(3, 30, 5\) and \(4, 25, 5\)"):
        matcher(*records(query, query_valid, template[0], template_valid, pixels, points))
    with pytest.raises(ValueError, match=r"query.valid must be bool of shape \(3, 30\), got \(3, 29\)"):
        matcher(*records(query, query_valid[:, :29], template, template_valid, pixels, points))
    with pytest.raises(ValueError, match=r"template.valid must be bool .* torch\.int64"):
        matcher(*records(query, query_valid, template, template_valid.long(), pixels, points))
    with pytest.raises(ValueError, match=r"query.pixels must have shape \(3, 30, 2\)"):
        matcher(*records(query, query_valid, template, template_valid, pixels[..., :1], points))
    with pytest.raises(ValueError, match=r"template.points_model must have shape \(3, 4, 25, 3\)"):
        matcher(*records(query, query_valid, template, template_valid, pixels, points[..., :2]))
    with pytest.raises(ValueError, match="temperature must be positive"):
        PatchMatcher(confidence_temperature=0.0)
    with pytest.raises(ValueError, match="got 'mutual'"):
        PatchMatcher("mutual")
    with pytest.raises(ValueError, match="top_k must be at least 1 or None, got 0"):
        PatchMatcher(top_k=0)

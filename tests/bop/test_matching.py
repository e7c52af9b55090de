import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foundpose.bop.matching import best, greedy_matches


def plain_match(errors, counted, valid, threshold):
    """One table, one threshold, one thing at a time. Returns the estimate of each annotation, -1 for none."""
    matched = [-1] * len(valid)
    for estimate in counted:
        best, smallest = -1, threshold
        for annotation, usable in enumerate(valid):
            if usable and matched[annotation] < 0 and errors[estimate][annotation] < smallest:
                best, smallest = annotation, errors[estimate][annotation]
        if best >= 0:
            matched[best] = estimate
    return matched


def batched_match(tables, thresholds):
    """All tables (errors, scores, visibility, inst_count) as one padded batch.

    Returns counted estimates and valid annotations of each table, and (N, T, g) matched estimates as given.
    """

    counted = [best(scores, count) for _, scores, _, count in tables]
    # One more row, so that there is padding even where no table has an estimate.
    rows = 1 + max(map(len, counted))
    # Padding holds the best of all errors, which nothing may ever take.
    errors = torch.full((len(tables), rows, max(len(t[2]) for t in tables)), -1.0, dtype=torch.float64)
    usable = torch.zeros(errors.shape, dtype=torch.bool)
    valid = []
    for index, (table, _, visibility, count) in enumerate(tables):
        chosen = best(visibility, count)
        valid.append([i in chosen for i in range(len(visibility))])
        for place, estimate in enumerate(counted[index]):
            for annotation in range(len(visibility)):
                errors[index, place, annotation] = table[estimate][annotation]
                usable[index, place, annotation] = valid[-1][annotation]
    places = greedy_matches(errors, thresholds, usable)
    estimates = torch.full_like(places, -1)
    for index, order in enumerate(counted):
        for place, estimate in enumerate(order):
            estimates[index][places[index] == place] = estimate
    return counted, valid, estimates


def test_equals_the_toolkit_on_its_tables(lmo_root):
    path = lmo_root.parent / "bop_reference" / "matching.json"
    if not path.is_file():
        pytest.skip(f"no reference numbers at {path}")
    tables = json.loads(path.read_text())["tables"]
    assert len(tables) == 24
    thresholds = torch.tensor(sorted({t["threshold"] for t in tables}), dtype=torch.float64)
    fields = ("errors", "scores", "visib_fract", "inst_count")
    counted, valid, estimates = batched_match([tuple(t[f] for f in fields) for t in tables], thresholds)
    for index, table in enumerate(tables):
        assert counted[index] == table["counted_estimates"]
        assert valid[index] == table["gt_valid"]
        row = estimates[index, thresholds.tolist().index(table["threshold"])]
        matched = row[: len(table["gt_valid"])].tolist()
        assert matched == table["gt_matched_estimate"]
        found = sum(m >= 0 for m in matched)
        assert found == table["found"]
        assert found / sum(valid[index]) == table["recall"]
        assert sum(valid[index]) == table["targets"]


# Few distinct values, so that equal scores, equal errors and errors equal to a threshold are common.
levels = st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.5, 0.75, 1.0])
broken = st.sampled_from([math.nan, math.inf, -math.inf])


@st.composite
def random_table(draw):
    n, g = draw(st.integers(0, 6)), draw(st.integers(0, 5))
    cell = st.one_of(levels, levels, levels, st.floats(0, 1), broken)
    errors = [[draw(cell) for _ in range(g)] for _ in range(n)]
    scores = [draw(levels) for _ in range(n)]
    return errors, scores, [draw(levels) for _ in range(g)], draw(st.integers(1, 5))


@given(st.lists(random_table(), min_size=1, max_size=4))
@settings(max_examples=150, deadline=None)
def test_equals_a_plain_loop(tables):
    thresholds = [0.25, 0.5, 0.6]
    counted, valid, estimates = batched_match(tables, torch.tensor(thresholds, dtype=torch.float64))
    for index, (errors, scores, visibility, count) in enumerate(tables):
        by_score = sorted(range(len(scores)), key=lambda i: -scores[i])[:count]
        by_visibility = sorted(range(len(visibility)), key=lambda i: -visibility[i])[:count]
        assert counted[index] == by_score
        assert valid[index] == [i in by_visibility for i in range(len(visibility))]
        finite = [[e if math.isfinite(e) else math.inf for e in row] for row in errors]
        for k, threshold in enumerate(thresholds):
            expected = plain_match(finite, by_score, valid[index], threshold)
            assert estimates[index, k, : len(expected)].tolist() == expected
            assert (estimates[index, k, len(expected) :] == -1).all()


def test_leading_dimensions_and_dtypes(rng):
    errors = torch.from_numpy(rng.uniform(size=(3, 10, 4, 5)))
    thresholds = torch.linspace(0.05, 0.5, 10, dtype=torch.float64)
    matched = greedy_matches(errors, thresholds)
    assert matched.shape == (3, 10, 10, 5)
    for target, tau in ((0, 0), (2, 9), (1, 4)):
        assert torch.equal(matched[target, tau], greedy_matches(errors[target, tau], thresholds))
    assert torch.equal(greedy_matches(errors.float(), thresholds), matched)
    assert greedy_matches(errors[:, :, :0], thresholds).eq(-1).all()
    assert greedy_matches(errors[..., :0], thresholds).shape == (3, 10, 10, 0)


def test_scores_that_are_no_numbers_come_last():
    values = [math.nan, 0.1, 9.0, 0.3, -math.inf]
    assert best(values, None) == [2, 3, 1, 0, 4]
    assert best(values, 2) == [2, 3]
    assert best([], 3) == []


def test_many_equal_scores_keep_their_order():
    assert best([0.0] * 1000, 999) == list(range(999))
    equal = greedy_matches(torch.full((300, 200), 0.1), torch.tensor([0.5]))
    assert torch.equal(equal[0], torch.arange(200))


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"shape \(\.\.\., n, g\).*got torch.float32 \(3,\)"):
        greedy_matches(torch.zeros(3), torch.zeros(1))
    with pytest.raises(ValueError, match="must be floating"):
        greedy_matches(torch.from_numpy(np.zeros((1, 2), int)), torch.zeros(1))

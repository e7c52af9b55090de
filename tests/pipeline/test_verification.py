import math

import pytest
import torch

from foundpose import InlierScore, PatchVerification
from foundpose.geometry import project_points, transform_points
from foundpose.geometry.transforms import se3_exp
from foundpose.pipeline.verification import pose_agreement
from foundpose.retrieval import QueryPatches


def view_of(representation, template):
    """A crop that is a template: its patches and its camera."""
    patches = representation.gather_templates(torch.tensor([template]))
    query = QueryPatches(patches.descriptors, patches.pixels, patches.valid)
    return query, representation.K_template[[template]], representation.T_template_from_model[[template]]


def by_loops(T, query, K, representation):
    """Similarity and coverage of one crop and pose, point by point."""
    info = representation.info
    traces = [float((T[:3, :3] * V[:3, :3]).sum()) for V in representation.T_template_from_model]
    view = max(range(len(traces)), key=traces.__getitem__)
    first, last = representation.template_offsets[view : view + 2].tolist()
    points = representation.points_model[first:last]
    pixels, _ = project_points(transform_points(T, points), K)
    cells = ((pixels - info.offset) / info.stride).tolist()
    scale = float(K[0, 0] / T[2, 3])
    V = representation.T_template_from_model[view]
    half = 0.5 * scale / float(representation.K_template[view, 0, 0] / V[2, 3]) + 0.1
    total, inside = 0.0, set()
    for p in range(query.valid.shape[1]):
        if not query.valid[0, p]:
            continue
        u, v = ((query.pixels[0, p] - info.offset) / info.stride).tolist()
        inside.add((round(u), round(v)))
        distances = [math.hypot(u - a, v - b) for a, b in cells]
        j = min(range(len(distances)), key=distances.__getitem__)
        if distances[j] < 1.0:
            x, y = query.descriptors[0, p], representation.descriptors[first + j]
            total += float(x @ y / (x.norm() * y.norm()))
    covered = {
        (i, k)
        for a, b in cells
        for i in range(math.floor(a) - 2, math.floor(a) + 4)
        for k in range(math.floor(b) - 2, math.floor(b) + 4)
        if max(abs(i - a), abs(k - b)) <= half and 0 <= i < info.grid and 0 <= k < info.grid
    }
    return total / int(query.valid.sum()), len(covered & inside) / len(covered | inside)


@pytest.mark.parametrize("twist", [[0.0] * 6, [0, 0, 0, 0.1, -0.05, 0.1], [0, 0, 0, 0.0, 0.0, 1.0]])
def test_equals_a_scalar_loop(oracle_blob, twist):
    query, K, T = view_of(oracle_blob, 3)
    T = T @ se3_exp(torch.tensor(twist))
    found = pose_agreement(T[:, None], query, K, oracle_blob)
    similarity, coverage = by_loops(T[0], query, K[0], oracle_blob)
    assert float(found.similarity[0, 0]) == pytest.approx(similarity, abs=1e-4)
    assert float(found.coverage[0, 0]) == pytest.approx(coverage, abs=0.005)


def test_the_true_pose_is_best(oracle_blob):
    query, K, T = view_of(oracle_blob, 5)
    turns = [[0, 0, 0, 0.3, 0, 0], [0, 0, 0, 0, 0, 0.3], [0, 0, 0, 0, math.pi, 0]]
    away = torch.tensor([[0.0, 0.0, float(f) * T[0, 2, 3], 0, 0, 0] for f in (0.1, -0.1)])
    moves = torch.cat([torch.zeros(1, 6), away])
    poses = torch.cat([se3_exp(moves) @ T, T @ se3_exp(torch.tensor(turns))])
    share = torch.zeros(1, len(poses))
    score = PatchVerification()(poses[None], share, query, K, oracle_blob)[0]
    assert score.argmax() == 0
    assert ((score >= 0) & (score <= 1)).all()
    agreement = pose_agreement(poses[None], query, K, oracle_blob)
    assert agreement.similarity[0, 0] > 0.99
    assert agreement.coverage[0, 0] > 0.9
    # Neither farther nor nearer covers the same cells.
    assert (agreement.coverage[0, 1:3] < agreement.coverage[0, 0] - 0.05).all()


def test_scores_are_weighted_means(oracle_blob):
    query, K, T = view_of(oracle_blob, 2)
    share = torch.tensor([[0.4]])
    found = pose_agreement(T[:, None], query, K, oracle_blob)
    expected = (0.4 + 2.0 * found.similarity + 3.0 * found.coverage) / 6.0
    torch.testing.assert_close(
        PatchVerification(2.0, 3.0)(T[:, None], share, query, K, oracle_blob), expected
    )
    assert torch.equal(InlierScore()(T[:, None], share, query, K, oracle_blob), share)


def test_nothing_in_sight_scores_nothing(oracle_blob):
    query, K, T = view_of(oracle_blob, 2)
    behind = T.clone()
    behind[:, 2, 3] *= -1.0
    bad = torch.cat([behind, torch.full_like(T, torch.nan)])
    found = pose_agreement(bad[None], query, K, oracle_blob)
    assert (found.similarity == 0).all()
    assert (found.coverage == 0).all()
    empty = query._replace(valid=torch.zeros_like(query.valid))
    found = pose_agreement(T[:, None], empty, K, oracle_blob)
    assert found.similarity.isfinite().all()
    assert found.coverage[0, 0] == 0


def test_batch_independence(oracle_blob):
    (a, K_a, T_a), (b, K_b, T_b) = view_of(oracle_blob, 1), view_of(oracle_blob, 4)
    both = QueryPatches(*(None if x is None else torch.cat([x, y]) for x, y in zip(a, b, strict=True)))
    T, K = torch.stack([torch.cat([T_a, T_b]), torch.cat([T_b, T_a])]), torch.cat([K_a, K_b])
    together = PatchVerification()(T, torch.zeros(2, 2), both, K, oracle_blob)
    alone = PatchVerification()(T[1:], torch.zeros(1, 2), b, K_b, oracle_blob)
    torch.testing.assert_close(together[1:], alone, atol=1e-6, rtol=0)


def test_bad_weights():
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        PatchVerification(-1)

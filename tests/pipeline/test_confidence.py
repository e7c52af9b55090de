import numpy as np
import pytest
import torch
from sklearn.linear_model import LogisticRegression

from foundpose import FoundPose, MatchAndSolve, PatchVerification, PoseStatus
from foundpose.evaluation.records import pose_records
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, intrinsics_matrix, make_transform, se3_exp
from foundpose.matching import PatchMatcher
from foundpose.pipeline import PoseConfidence, PoseEvidence, fit_confidence, pose_evidence, reliability
from foundpose.pnp import RansacPnp
from foundpose.rendering import CoordinateRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import SoftAssignBow, TemplateRetriever

SIZE = (480, 640)
K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)
CONFIDENCE = PoseConfidence({"inliers": 4.0, "coverage": 2.0, "size": 0.5}, -3.0)


@pytest.fixture(scope="module")
def seen(blob, oracle_blob):
    """Estimates of two blobs in one picture, and the true poses."""
    centre = blob.bounds.mean(0)
    T = torch.stack([torch.eye(4), se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.4, 1.0, -0.3]))])
    T[:, :3, 3] = torch.tensor([[-90.0, -60.0, 700.0], [120.0, 50.0, 900.0]]) - T[:, :3, :3] @ centre
    renderer = CoordinateRenderer()
    image = render_coordinate_image(renderer, [blob, blob], list(T), K, SIZE)
    masks = renderer(blob, T, K.expand(2, 3, 3), SIZE).mask
    pipeline = FoundPose(
        PerspectiveCrop(),
        CoordinateCode(),
        TemplateRetriever(SoftAssignBow()),
        MatchAndSolve(PatchMatcher(), RansacPnp(), PatchVerification()),
        confidence=CONFIDENCE,
    ).eval()
    with torch.no_grad():
        estimates = pipeline(
            image[None], K[None], oracle_blob, masks=masks, image_index=torch.zeros(2).long()
        )
    return pipeline, image, masks, estimates


def test_right_poses_have_the_evidence(seen, blob):
    estimates = seen[-1]
    evidence = estimates.evidence
    for name in ("inliers", "similarity", "coverage", "alignment", "consensus"):
        assert bool((getattr(evidence, name) > 0.7).all()), name
    # fx · diameter / distance, in units of 100 px.
    distance = estimates.T_camera_from_model[:, :3, 3].norm(dim=1)
    assert torch.allclose(evidence.size, torch.log2(600.0 * blob.diameter / distance / 100.0), atol=1e-3)
    assert torch.equal(estimates.probability, CONFIDENCE(evidence))


@pytest.mark.parametrize("angle", [0.3, 1.0, 3.0])
def test_wrong_poses_lack_it(seen, angle):
    """Of a pose turned about the line of sight, all but inliers and size are worse, which are not looked at again."""
    estimates = seen[-1]
    turn = make_transform(se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, angle]))[:3, :3], torch.zeros(3))
    T = estimates.T_camera_from_model.clone()
    T[:, :3, :3] = turn[:3, :3] @ T[:, :3, :3]
    wrong = pose_evidence(estimates._replace(T_camera_from_model=T), estimates.observation)
    for name in ("similarity", "coverage", "alignment", "consensus"):
        assert bool((getattr(wrong, name) < getattr(estimates.evidence, name)).all()), name
    assert torch.equal(wrong.inliers, estimates.evidence.inliers)


def test_a_crop_alone_has_the_same_evidence(seen, oracle_blob):
    pipeline, image, masks, estimates = seen
    for i in range(2):
        with torch.no_grad():
            alone = pipeline(image[None], K[None], oracle_blob, masks=masks[i, None])
        for name, value in alone.evidence._asdict().items():
            assert torch.allclose(value, getattr(estimates.evidence, name)[i], atol=1e-5), name


def test_a_crop_without_a_pose_has_probability_zero(seen, oracle_blob):
    pipeline, image, masks, _ = seen
    nothing = torch.zeros_like(masks[:1])
    with torch.no_grad():
        estimates = pipeline(
            image[None],
            K[None],
            oracle_blob,
            masks=torch.cat([masks[:1], nothing]),
            image_index=torch.zeros(2).long(),
        )
    assert estimates.valid.tolist() == [True, False]
    assert float(estimates.probability[1]) == 0.0
    assert all(bool(torch.isfinite(value).all()) for value in estimates.evidence)


def test_withheld_poses_are_not_valid(seen):
    estimates = seen[-1]._replace(probability=torch.tensor([0.4, 0.6]))
    held = estimates.withhold(0.5)
    assert held.valid.tolist() == [False, True]
    assert held.status.tolist() == [PoseStatus.UNLIKELY, PoseStatus.OK]
    records = pose_records(held)
    assert [(r["valid"], r["status"]) for r in records] == [(False, "UNLIKELY"), (True, "OK")]
    assert records[1]["probability"] == pytest.approx(0.6)
    assert list(records[0]["evidence"]) == list(PoseEvidence._fields)
    assert estimates.withhold(0.0).valid.all()
    assert estimates._replace(probability=None).withhold(0.5).valid.all()


def test_gradients_reach_the_pose_and_the_features(seen):
    """By finite differences, in double precision."""
    estimates = seen[-1]
    observation = estimates.observation
    features = observation.features._replace(patches=observation.features.patches.clone().requires_grad_())

    def probability(twist):
        T = se3_exp(twist) @ estimates.T_camera_from_model.double()
        moved = estimates._replace(T_camera_from_model=T.float())
        evidence = pose_evidence(moved, observation._replace(features=features))
        return (evidence.alignment + evidence.consensus + evidence.size).double()

    twist = torch.tensor([[3.0, -2.0, 5.0, 0.05, 0.02, -0.04]] * 2, dtype=torch.float64, requires_grad=True)
    gradient, of_features = torch.autograd.grad(probability(twist).sum(), [twist, features.patches])
    assert float(of_features.abs().sum()) > 0
    for axis, step in ((0, 0.05), (2, 0.2), (4, 1e-4), (5, 1e-4)):
        offset = torch.zeros(2, 6, dtype=torch.float64)
        offset[:, axis] = step
        with torch.no_grad():
            slope = (probability(twist + offset) - probability(twist - offset)) / (2 * step)
        assert torch.allclose(
            gradient[:, axis], slope, rtol=0.1, atol=0.05 * float(gradient[:, axis].abs().max())
        )


def test_gradcheck_of_the_probability():
    confidence = PoseConfidence({"inliers": 4.0, "size": -0.5}, 0.3).double()
    evidence = [torch.rand(3, dtype=torch.float64, requires_grad=True) for _ in PoseEvidence._fields]
    assert torch.autograd.gradcheck(lambda *x: confidence(PoseEvidence(*x)), evidence)
    with pytest.raises(ValueError, match=r"weights must be of inliers, .*; got inlier"):
        PoseConfidence({"inlier": 1.0}, 0.0)


def test_numbers_are_saved_and_moved():
    other = PoseConfidence({}, 0.0)
    other.load_state_dict(CONFIDENCE.state_dict())
    assert torch.equal(other.weight, CONFIDENCE.weight)
    assert other.double().bias.dtype == torch.float64
    assert "inliers=4" in repr(CONFIDENCE)


def made_up(count=400):
    rng = np.random.default_rng(0)
    x = rng.normal([0.4, 0.5, 0.6, 0.4, 0.2, 0.0], [0.2, 0.1, 0.2, 0.1, 0.1, 1.0], size=(count, 6))
    p = 1 / (1 + np.exp(-(8 * x[:, 0] + 4 * x[:, 3] - 0.7 * x[:, 5] - 5)))
    right = torch.from_numpy(rng.uniform(size=count) < p)
    return PoseEvidence(*torch.from_numpy(x).unbind(1)), right, torch.from_numpy(p)


def test_the_fit_equals_scikit_learns():
    """With the same decay: C is one over twice ours, on standardised evidence."""
    evidence, right, truth = made_up()
    fitted = fit_confidence(evidence, right, decay=0.5)
    x = torch.stack(evidence, 1)
    x = ((x - x.mean(0)) / x.std(0)).numpy()
    reference = LogisticRegression(C=1.0, tol=1e-10, max_iter=1000).fit(x, right.numpy())
    expected = torch.from_numpy(reference.predict_proba(x)[:, 1])
    assert torch.allclose(fitted(evidence).double(), expected, atol=1e-4)
    assert float((fitted(evidence) - truth).abs().mean()) < 0.06


def test_another_share_of_right_poses_moves_the_bias():
    """Poses drawn so that more are right than in those of the fit, with the same evidence for each kind."""
    evidence, right, _ = made_up(20_000)
    keep = right | (torch.rand(len(right), generator=torch.Generator().manual_seed(1)) < 0.25)
    more = PoseEvidence(*(part[keep] for part in evidence))
    share = float(right[keep].double().mean())
    adapted = fit_confidence(evidence, right, share_right=share)
    plain = fit_confidence(evidence, right)
    assert torch.equal(adapted.weight, plain.weight)
    assert reliability(adapted(more), right[keep]).error < 0.02 < reliability(plain(more), right[keep]).error
    assert float(adapted(more).mean()) == pytest.approx(share, abs=0.01)
    with pytest.raises(ValueError, match="share_right must be between 0 and 1, got 1"):
        fit_confidence(evidence, right, share_right=1)


def test_a_fit_needs_both_kinds():
    evidence, right, _ = made_up(20)
    with pytest.raises(ValueError, match="20 of 20 poses are right"):
        fit_confidence(evidence, torch.ones_like(right))
    separable = evidence._replace(inliers=right.double())
    assert bool(torch.isfinite(fit_confidence(separable, right).weight).all())


def test_reliability_by_hand():
    """Bins of a half: {0.1, 0.3}, of which one is right, and {0.5, 0.9, 1.0}, of which two are.

    Means 0.2 and 0.8, shares 1/2 and 2/3: the error is (2 · 0.3 + 3 · 0.1333) / 5 = 0.2. The squares are 0.81, 0.09,
    0.25, 0.01 and 1.
    """
    probability = torch.tensor([0.1, 0.3, 0.5, 0.9, 1.0], dtype=torch.float64)
    right = torch.tensor([True, False, True, True, False])
    found = reliability(probability, right, bins=2)
    assert found.count.tolist() == [2, 3]
    assert found.probability.tolist() == pytest.approx([0.2, 0.8])
    assert found.share.tolist() == pytest.approx([1 / 2, 2 / 3])
    assert found.error == pytest.approx(0.2)
    assert found.brier == pytest.approx(2.16 / 5)
    sparse = reliability(probability[:1], right[:1]).to_json()
    assert sparse["bins"][0] == {"poses": 0, "probability": None, "right": None}
    assert sparse["bins"][1] == {"poses": 1, "probability": pytest.approx(0.1), "right": 1.0}
    assert "expected calibration error 0.200" in found.table()
    with pytest.raises(ValueError, match=r"got \(5,\) and \(4,\)"):
        reliability(probability, right[:4])

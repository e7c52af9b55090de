import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.feature_extraction.text import TfidfTransformer
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

import foundpose.retrieval.bow as bow_module
from foundpose.retrieval.bow import (
    SoftAssignBow,
    assign_words,
    inverse_document_frequency,
    nearest_words,
    signed_root,
    tf_idf,
    word_counts,
)


def crops(
    num_crops: int,
    num_patches: int,
    num_words: int,
    channels: int,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Random descriptors (B, P, d), ragged masks (B, P), words (k, d)."""
    g = torch.Generator().manual_seed(seed)
    words = torch.randn(num_words, channels, generator=g, dtype=torch.float64)
    descriptors = torch.randn(num_crops, num_patches, channels, generator=g, dtype=torch.float64)
    valid = torch.rand(num_crops, num_patches, generator=g) < torch.linspace(0.3, 1.0, num_crops)[:, None]
    return descriptors.to(dtype), valid, words.to(dtype)


def brute_force(
    x: np.ndarray, valid: np.ndarray, words: np.ndarray, idf: np.ndarray, sigma: float, m: int
) -> np.ndarray:
    """The paper's formula, crop by crop and patch by patch."""
    out = np.zeros((len(x), len(words)))
    for crop in range(len(x)):
        patches = x[crop][valid[crop]]
        for patch in patches:
            d2 = ((words - patch) ** 2).sum(1)
            nearest = np.argsort(d2)[:m]
            weight = np.exp(-d2[nearest] / (2 * sigma**2))
            out[crop, nearest] += weight / weight.sum() / len(patches)
    return out * idf


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_equals_brute_force(dtype: torch.dtype, tolerance: float) -> None:
    x, valid, words = crops(5, 40, 70, 8, dtype)
    idf = torch.rand(70, generator=torch.Generator().manual_seed(1), dtype=dtype)
    got = SoftAssignBow(sigma=1.3, num_nearest=3, normalization="cosine")(x, valid, words, idf)
    expected = brute_force(
        x.double().numpy(), valid.numpy(), words.double().numpy(), idf.double().numpy(), 1.3, 3
    )
    assert got.dtype == dtype
    torch.testing.assert_close(got.double(), torch.from_numpy(expected), atol=tolerance, rtol=tolerance)


def test_hellinger_takes_signed_roots_of_the_formula() -> None:
    x, valid, words = crops(5, 40, 70, 8)
    idf = torch.randn(70, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = brute_force(x.numpy(), valid.numpy(), words.numpy(), idf.numpy(), 1.3, 3)
    got = SoftAssignBow(1.3, 3, "hellinger")(x, valid, words, idf)
    expected = np.sign(expected) * np.sqrt(np.abs(expected))
    torch.testing.assert_close(got, torch.from_numpy(expected), atol=1e-9, rtol=1e-9)


def test_hellingers_cosine_is_the_affinity_of_distributions() -> None:
    counts = torch.rand(2, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    bags = SoftAssignBow(1.0).weigh(counts, torch.ones(30).double())
    p, q = counts / counts.sum(dim=1, keepdim=True)
    torch.testing.assert_close(torch.cosine_similarity(bags[:1], bags[1:])[0], (p * q).sqrt().sum())


def test_a_root_of_nothing_has_no_gradient() -> None:
    x = torch.tensor([0.0, 4.0, -9.0], dtype=torch.float64, requires_grad=True)
    root = signed_root(x)
    assert root.tolist() == [0.0, 2.0, -3.0]
    (gradient,) = torch.autograd.grad(root.sum(), x)
    torch.testing.assert_close(gradient, torch.tensor([0.0, 1 / 4, 1 / 6]).double())


def test_an_automatic_sigma_follows_the_words() -> None:
    x, valid, words = crops(5, 40, 70, 8)
    idf = torch.ones(70).double()
    auto = SoftAssignBow("auto")
    assert torch.equal(auto(x, valid, words, idf, 2.0), SoftAssignBow(0.8)(x, valid, words, idf))
    with pytest.raises(ValueError, match="sigma is auto: give word_distance"):
        auto(x, valid, words, idf)


def test_nearest_words_equal_sklearn() -> None:
    x, _, words = crops(1, 500, 300, 16)
    distance, index = nearest_words(x[0], words, 4)
    reference_distance, reference = (
        NearestNeighbors(n_neighbors=4).fit(words.numpy()).kneighbors(x[0].numpy())
    )
    assert torch.equal(index, torch.from_numpy(reference))
    torch.testing.assert_close(distance.sqrt(), torch.from_numpy(reference_distance))


@pytest.mark.parametrize("words", [63, 64, 256, 2048])
def test_the_search_in_groups_equals_topk(words: int) -> None:
    scores = torch.randn(50, words, generator=torch.Generator().manual_seed(words))
    found = bow_module._smallest(scores, 3).sort(dim=1).values
    assert torch.equal(found, scores.topk(3, dim=1, largest=False).indices.sort(dim=1).values)


def test_idf_equals_sklearn_and_is_not_negative() -> None:
    x, valid, words = crops(12, 30, 60, 5)
    assignment = assign_words(x, valid, words, sigma=1.0, num_nearest=2)
    hard = np.zeros((12, 60), dtype=int)
    for crop, patch in zip(*np.nonzero(valid.numpy()), strict=True):
        hard[crop, assignment.word[crop, patch].numpy()] += 1
    idf = inverse_document_frequency(assignment, valid, 60)
    present = hard.any(axis=0)
    # scikit-learn's idf is log(N / n_i) + 1 without smoothing.
    reference = TfidfTransformer(smooth_idf=False).fit(hard[:, present]).idf_ - 1.0
    np.testing.assert_allclose(idf.numpy()[present], reference, atol=1e-12)
    assert 0 < present.sum() < 60
    assert (idf.numpy()[~present] == 0).all()
    assert (idf >= 0).all()


def test_idf_of_occurrences_is_the_papers_formula() -> None:
    x, valid, words = crops(12, 30, 20, 5)
    assignment = assign_words(x, valid, words, sigma=1.0, num_nearest=3)
    total = word_counts(assignment, 20).sum(0)
    idf = inverse_document_frequency(assignment, valid, 20, mode="occurrence")
    np.testing.assert_allclose(idf.numpy(), [math.log(12 / n) if n > 0 else 0.0 for n in total.tolist()])
    assert (idf < 0).any()
    with pytest.raises(ValueError, match="'document' or 'occurrence', got 'log'"):
        inverse_document_frequency(assignment, valid, 20, mode="log")


def test_word_in_every_template_weighs_nothing() -> None:
    words = torch.tensor([[0.0], [10.0], [20.0]])
    x = torch.tensor([[[0.0], [10.0]], [[0.1], [19.0]]])
    valid = torch.ones(2, 2, dtype=torch.bool)
    assignment = assign_words(x, valid, words, sigma=1.0, num_nearest=1)
    idf = inverse_document_frequency(assignment, valid, 3)
    torch.testing.assert_close(idf, torch.tensor([0.0, math.log(2), math.log(2)]))
    torch.testing.assert_close(
        tf_idf(word_counts(assignment, 3), idf), torch.tensor([[0, 0.5, 0], [0, 0, 0.5]]) * math.log(2)
    )


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    num_nearest=st.integers(1, 6),
    sigma=st.sampled_from([1e-25, 1e-3, 0.5, 10.0, 1e6]),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_laws(seed: int, num_nearest: int, sigma: float, scale: float) -> None:
    x, valid, words = crops(3, 12, 5, 4, torch.float32, seed)
    x, words = x * scale, words * scale
    assignment = assign_words(x, valid, words, sigma, num_nearest)
    counts = word_counts(assignment, 5)
    torch.testing.assert_close(counts.sum(1), valid.sum(1).float())
    assert (counts >= 0).all()
    idf = inverse_document_frequency(assignment, valid, 5)
    assert ((idf >= 0) & (idf <= math.log(3) + 1e-6)).all()
    vectors = SoftAssignBow(sigma, num_nearest)(x, valid, words, idf)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(seed))
    shuffled = SoftAssignBow(sigma, num_nearest)(x[:, order], valid[:, order], words, idf)
    torch.testing.assert_close(vectors, shuffled, atol=1e-4, rtol=1e-3)


def test_padding_and_batch_independence() -> None:
    x, valid, words = crops(6, 25, 40, 8)
    idf = torch.rand(40, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    bow = SoftAssignBow(1.0)
    expected = bow(x, valid, words, idf)
    for crop in range(6):
        alone = bow(x[crop, valid[crop]][None], valid[crop, valid[crop]][None], words, idf)
        torch.testing.assert_close(alone[0], expected[crop], atol=1e-12, rtol=1e-12)
    garbage = torch.cat(
        [x.masked_fill(~valid[..., None], torch.nan), torch.full((6, 7, 8), 1e30).double()], dim=1
    )
    padded = torch.cat([valid, torch.zeros(6, 7, dtype=torch.bool)], dim=1)
    garbage.requires_grad_()
    got = bow(garbage, padded, words, idf)
    torch.testing.assert_close(got, expected)
    got.sum().backward()
    assert garbage.grad is not None
    assert garbage.grad.isfinite().all()
    assert (garbage.grad[~padded] == 0).all()


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    x, valid, words = crops(4, 50, 30, 8)
    idf = torch.ones(30, dtype=torch.float64)
    expected = SoftAssignBow(1.0)(x, valid, words, idf)
    monkeypatch.setattr(bow_module, "_DISTANCES_PER_BLOCK", 30 * 7)
    torch.testing.assert_close(SoftAssignBow(1.0)(x, valid, words, idf), expected, atol=1e-13, rtol=1e-12)


def test_crop_without_patches_and_empty_batch() -> None:
    x, valid, words = crops(3, 10, 8, 4)
    valid[1] = False
    x.requires_grad_()
    vectors = SoftAssignBow(1.0)(x, valid, words, torch.ones(8).double())
    assert (vectors[1] == 0).all()
    assert (vectors[[0, 2]].sum(1) > 0).all()
    vectors.square().sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()
    for shape in [(0, 10), (3, 0)]:
        empty = SoftAssignBow(1.0)(
            torch.zeros(*shape, 4), torch.zeros(shape, dtype=torch.bool), words.float(), torch.ones(8)
        )
        assert empty.shape == (shape[0], 8)
        assert (empty == 0).all()


def test_gradcheck() -> None:
    x, valid, words = crops(2, 6, 5, 3)
    idf = torch.rand(5, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    inputs = [t.requires_grad_() for t in (x, words, idf)]
    bow = SoftAssignBow(1.0, 3)
    assert torch.autograd.gradcheck(lambda a, b, c: bow(a, valid, b, c), inputs)


def test_small_sigma_is_hard_assignment() -> None:
    x, valid, words = crops(2, 20, 10, 4)
    ones = torch.ones(10, dtype=torch.float64)
    soft = SoftAssignBow(sigma=1e-3, num_nearest=3)(x, valid, words, ones)
    hard = SoftAssignBow(sigma=1.0, num_nearest=1)(x, valid, words, ones)
    torch.testing.assert_close(soft, hard)


def test_fewer_words_than_nearest() -> None:
    x, valid, words = crops(2, 20, 2, 4)
    assert assign_words(x, valid, words, 1.0, 3).word.shape == (2, 20, 2)


def test_bad_input() -> None:
    x, valid, words = crops(2, 20, 10, 4)
    bow = SoftAssignBow()
    ones = torch.ones(10).double()
    with pytest.raises(ValueError, match=r"got \(2, 20, 4\) and \(2, 19\)"):
        bow(x, valid[:, :19], words, ones)
    with pytest.raises(ValueError, match=r"torch\.float64"):
        bow(x, valid.double(), words, ones)
    with pytest.raises(ValueError, match=r"words must have shape \(k, 4\), got \(10, 3\)"):
        bow(x, valid, words[:, :3], ones)
    with pytest.raises(ValueError, match=r"idf must have shape \(10,\), got \(9,\)"):
        bow(x, valid, words, ones[:9])
    with pytest.raises(ValueError, match="sigma must be positive, got 0"):
        SoftAssignBow(sigma=0)
    with pytest.raises(ValueError, match="num_nearest must be at least 1, got 0"):
        SoftAssignBow(num_nearest=0)
    with pytest.raises(ValueError, match="got 'l1'"):
        SoftAssignBow(normalization="l1")
    with pytest.raises(ValueError, match="sigma must be a number or 'auto', got 'wide'"):
        SoftAssignBow(sigma="wide")

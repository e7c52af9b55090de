from typing import NamedTuple

import pytest
import torch
from sklearn.metrics.pairwise import cosine_similarity
from torch import Tensor

from foundpose.retrieval.base import QueryPatches
from foundpose.retrieval.bow import (
    SoftAssignBow,
    assign_words,
    inverse_document_frequency,
    tf_idf,
    word_counts,
)
from foundpose.retrieval.retriever import TemplateRetriever, normalize_rows, select_templates


class Index(NamedTuple):
    words: Tensor
    idf: Tensor
    template_bow: Tensor


BOW = SoftAssignBow(sigma=1.0, num_nearest=3, normalization="cosine")


def templates(count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Index]:
    """Templates (descriptors, valid) that each favour some words, and their index."""
    g = torch.Generator().manual_seed(0)
    words = torch.randn(50, 6, generator=g, dtype=torch.float64).to(dtype)
    favourite = torch.randint(50, (count, 8), generator=g)
    pick = favourite.gather(1, torch.randint(8, (count, 30), generator=g))
    x = words[pick] + 0.1 * torch.randn(count, 30, 6, generator=g, dtype=torch.float64).to(dtype)
    valid = torch.rand(count, 30, generator=g) < 0.8
    assignment = assign_words(x, valid, words, 1.0, 3)
    idf = inverse_document_frequency(assignment, valid, 50)
    return x, valid, Index(words, idf, normalize_rows(tf_idf(word_counts(assignment, 50), idf)))


def query(x: Tensor, valid: Tensor) -> QueryPatches:
    return QueryPatches(x, x.new_zeros(*x.shape[:2], 2), valid)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_templates_retrieve_themselves_with_similarity_one(dtype: torch.dtype) -> None:
    x, valid, index = templates(40, dtype)
    result = TemplateRetriever(BOW, 5)(query(x, valid), index)
    assert torch.equal(result.index[:, 0], torch.arange(40))
    torch.testing.assert_close(result.similarity[:, 0], torch.ones(40, dtype=dtype), atol=1e-5, rtol=0)
    assert result.valid.all()
    assert (result.similarity.diff(dim=1) <= 0).all()


def test_equals_sklearn_cosine_similarity() -> None:
    x, valid, index = templates(40)
    noisy = x[:7] + 0.5 * torch.randn(7, 30, 6, dtype=x.dtype, generator=torch.Generator().manual_seed(4))
    result = TemplateRetriever(BOW, 5)(query(noisy, valid[:7]), index)
    reference = torch.from_numpy(
        cosine_similarity(BOW(noisy, valid[:7], index.words, index.idf), index.template_bow)
    ).topk(5)
    torch.testing.assert_close(result.similarity, reference.values)
    assert torch.equal(result.index, reference.indices)


def test_half_of_the_patches_hidden_still_retrieves_the_template() -> None:
    x, valid, index = templates(40)
    hidden = valid & (torch.arange(30) < 15)
    result = TemplateRetriever(BOW, 5)(query(x, hidden), index)
    assert (result.index == torch.arange(40)[:, None]).any(1).float().mean() > 0.95


def test_more_templates_asked_than_exist_and_crop_without_patches() -> None:
    x, valid, index = templates(3)
    valid = valid.clone()
    valid[1] = False
    result = TemplateRetriever(BOW, 5)(query(x, valid), index)
    expected = torch.tensor([[True] * 3 + [False] * 2, [False] * 5, [True] * 3 + [False] * 2])
    assert torch.equal(result.valid, expected)
    assert (result.similarity[~expected] == -torch.inf).all()
    assert result.similarity[expected].isfinite().all()
    assert (result.index[~expected] == 0).all()
    assert sorted(result.index[0, :3].tolist()) == [0, 1, 2]


def test_ties_go_to_the_lowest_index() -> None:
    similarity = torch.tensor([[0.5, 0.9, 0.5, 0.9, 0.5]]).repeat(2, 200)
    result = select_templates(similarity, torch.tensor([True, True]), 4)
    assert result.index.tolist() == [[1, 3, 6, 8]] * 2


def test_batch_independence() -> None:
    x, valid, index = templates(40)
    retriever = TemplateRetriever(BOW, 4)
    together = retriever(query(x, valid), index)
    for crop in (0, 17, 39):
        alone = retriever(query(x[crop : crop + 1], valid[crop : crop + 1]), index)
        assert torch.equal(alone.index[0], together.index[crop])
        torch.testing.assert_close(alone.similarity[0], together.similarity[crop])


def test_gradients() -> None:
    x, valid, index = templates(6)
    retriever = TemplateRetriever(BOW, 2)
    g = torch.Generator().manual_seed(9)
    point = (x[:2, :5] + 0.3 * torch.randn(2, 5, 6, generator=g, dtype=x.dtype)).requires_grad_()
    words = index.words.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a, w: retriever(query(a, valid[:2, :5]), index._replace(words=w)).similarity, (point, words)
    )


def test_gradient_is_finite_where_nothing_is_known() -> None:
    x, valid, index = templates(6)
    x.requires_grad_()
    # No informative word at all: zero vectors, equal similarities.
    flat = index._replace(idf=torch.zeros_like(index.idf), template_bow=torch.zeros_like(index.template_bow))
    result = TemplateRetriever(BOW, 2)(query(x, valid & (torch.arange(6) > 0)[:, None]), flat)
    result.similarity[result.valid].sum().backward()
    assert result.index[1:].tolist() == [[0, 1]] * 5
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_bad_input() -> None:
    x, valid, index = templates(4)
    with pytest.raises(ValueError, match=r"template_bow must have shape \(T, 50\), got \(4, 49\)"):
        TemplateRetriever(BOW)(query(x, valid), index._replace(template_bow=index.template_bow[:, :49]))
    with pytest.raises(ValueError, match="num_templates must be at least 1, got 0"):
        TemplateRetriever(BOW, 0)

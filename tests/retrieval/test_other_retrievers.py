"""Retrieval by cls tokens and by direct matching of patches."""

from typing import NamedTuple

import pytest
import torch
from sklearn.metrics.pairwise import cosine_similarity
from torch import Tensor

from foundpose.retrieval import ClsRetriever, PatchVoteRetriever, QueryPatches
from foundpose.retrieval.votes import template_similarities


class Index(NamedTuple):
    """The part of an object representation that these retrievers read."""

    descriptors: Tensor
    template_offsets: Tensor
    max_patches: int
    template_cls: Tensor | None

    def read_descriptors(self, rows: Tensor) -> Tensor:
        return self.descriptors[rows]


COUNTS = [5, 17, 0, 1, 30, 12, 17, 3, 8, 25, 11, 2, 9, 14, 21, 6, 0, 19, 7, 4]


def make_index(dtype: torch.dtype = torch.float64, d: int = 6) -> Index:
    g = torch.Generator().manual_seed(0)
    offsets = torch.tensor([0, *COUNTS]).cumsum(0)
    descriptors = torch.randn(sum(COUNTS), d, generator=g, dtype=torch.float64) * 40
    cls = torch.randn(len(COUNTS), 5, generator=g, dtype=torch.float64)
    return Index(descriptors.to(dtype), offsets, max(COUNTS), cls.to(dtype))


def make_query(dtype: torch.dtype = torch.float64, d: int = 6, B: int = 4, P: int = 13) -> QueryPatches:
    g = torch.Generator().manual_seed(1)
    x = torch.randn(B, P, d, generator=g, dtype=torch.float64).to(dtype)
    valid = torch.rand(B, P, generator=g) < 0.7
    cls = torch.randn(B, 5, generator=g, dtype=torch.float64).to(dtype)
    return QueryPatches(x, x.new_zeros(B, P, 2), valid, cls)


def votes_by_loop(query: QueryPatches, index: Index) -> Tensor:
    """Similarities (B, T), template by template with scikit-learn."""
    result = torch.full((len(query.valid), len(COUNTS)), -torch.inf, dtype=torch.float64)
    for b, (x, valid) in enumerate(zip(query.descriptors, query.valid, strict=True)):
        for t, count in enumerate(COUNTS):
            if count > 0:
                start = index.template_offsets[t]
                patches = index.descriptors[start : start + count].double()
                result[b, t] = cosine_similarity(x[valid].double(), patches).max(axis=1).mean()
    return result


@pytest.mark.parametrize("stored", [torch.float64, torch.float32, torch.float16])
def test_patch_votes_equal_a_loop(stored: torch.dtype) -> None:
    index = make_index(stored)
    query = make_query(torch.float64 if stored == torch.float64 else torch.float32)
    found = PatchVoteRetriever(5)(query, index)
    # The loop reads the same rounded descriptors, so that only the arithmetic differs.
    reference = votes_by_loop(query, index).topk(5)
    assert found.similarity.dtype == query.descriptors.dtype
    torch.testing.assert_close(
        found.similarity.double(), reference.values, rtol=0, atol=1e-12 if stored == torch.float64 else 1e-6
    )
    assert torch.equal(found.index, reference.indices)
    assert found.valid.all()


def test_patch_votes_do_not_depend_on_the_chunk() -> None:
    query, index = make_query(), make_index()
    whole = PatchVoteRetriever(8)(query, index)
    for chunk in (1, 700, 3000):
        part = PatchVoteRetriever(8, chunk=chunk)(query, index)
        assert torch.equal(part.index, whole.index)
        torch.testing.assert_close(part.similarity, whole.similarity, rtol=0, atol=1e-13)


@pytest.mark.parametrize("retriever", [PatchVoteRetriever(4), ClsRetriever(4)])
def test_batch_independence(retriever: PatchVoteRetriever | ClsRetriever) -> None:
    query, index = make_query(B=7), make_index()
    query.valid[3] = False
    # What stands in patches that do not exist must not matter.
    query.descriptors[~query.valid] = 1e6
    together = retriever(query, index)
    assert together.valid.any(1).tolist() == [True] * 3 + [False] + [True] * 3
    assert (together.similarity[3] == -torch.inf).all()
    for b in range(7):
        keep = query.valid[b] if b != 3 else slice(None)
        alone = retriever(
            QueryPatches(
                query.descriptors[b : b + 1, keep],
                query.pixels[b : b + 1, keep],
                query.valid[b : b + 1, keep],
                query.cls[b : b + 1],
            ),
            index,
        )
        assert torch.equal(alone.index[0], together.index[b])
        assert torch.equal(alone.valid[0], together.valid[b])
        torch.testing.assert_close(alone.similarity[0], together.similarity[b], rtol=0, atol=1e-13)


def test_a_template_votes_for_itself_and_templates_without_patches_are_never_found() -> None:
    index = make_index()
    for t in (1, 4, 9):
        rows = slice(int(index.template_offsets[t]), int(index.template_offsets[t + 1]))
        x = 3.0 * index.descriptors[None, rows]
        query = QueryPatches(x, x.new_zeros(*x.shape[:2], 2), torch.ones(x.shape[:2], dtype=torch.bool))
        found = PatchVoteRetriever(25)(query, index)
        assert found.index[0, 0] == t
        torch.testing.assert_close(found.similarity[0, 0], x.new_tensor(1.0))
        assert found.valid[0].tolist() == [True] * 18 + [False] * 7
        assert not set(found.index[0, :18].tolist()) & {2, 16}


def test_patch_votes_have_the_gradients_of_the_whole_computation() -> None:
    query, index = make_query(B=2), make_index()
    x = query.descriptors.clone().requires_grad_()
    stored = index.descriptors.clone().requires_grad_()
    retriever = PatchVoteRetriever(3)

    def kept(x: Tensor, stored: Tensor) -> Tensor:
        return retriever(query._replace(descriptors=x), index._replace(descriptors=stored)).similarity

    weight = torch.linspace(1, 2, 6, dtype=torch.float64).reshape(2, 3)
    gradients = torch.autograd.grad((kept(x, stored) * weight).sum(), (x, stored))
    # The same with a graph over all templates.
    everything = template_similarities(x, query.valid, stored, index.template_offsets, 10**9)
    expected = torch.autograd.grad((everything.topk(3).values * weight).sum(), (x, stored))
    for gradient, reference in zip(gradients, expected, strict=True):
        assert reference.abs().max() > 0
        torch.testing.assert_close(gradient, reference)
    assert torch.autograd.gradcheck(lambda a: kept(a, stored.detach()), (x,))
    # With and without a graph, the values are the same to the last bit.
    assert torch.equal(kept(x, stored).detach(), kept(x.detach(), stored.detach()))


def test_gradients_reach_descriptors_stored_in_half_precision() -> None:
    index = make_index(torch.float16)
    stored = index.descriptors.clone().requires_grad_()
    found = PatchVoteRetriever(2)(make_query(torch.float32), index._replace(descriptors=stored))
    found.similarity.sum().backward()
    assert stored.grad is not None
    assert stored.grad.isfinite().all()
    assert stored.grad.abs().max() > 0


def test_cls_equals_sklearn() -> None:
    query, index = make_query(), make_index()
    found = ClsRetriever(6)(query, index)
    reference = torch.from_numpy(cosine_similarity(query.cls, index.template_cls)).topk(6)
    torch.testing.assert_close(found.similarity, reference.values)
    assert torch.equal(found.index, reference.indices)


def test_cls_gradients() -> None:
    query, index = make_query(), make_index()
    tokens = query.cls.clone().requires_grad_()
    stored = index.template_cls.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a, b: ClsRetriever(3)(query._replace(cls=a), index._replace(template_cls=b)).similarity,
        (tokens, stored),
    )


def test_bad_input() -> None:
    query, index = make_query(), make_index()
    with pytest.raises(ValueError, match=r"the extractor gives no cls token: .*retrieval=bag_of_words"):
        ClsRetriever()(query._replace(cls=None), index)
    with pytest.raises(ValueError, match="the object's templates have no cls token"):
        ClsRetriever()(query, index._replace(template_cls=None))
    with pytest.raises(ValueError, match=r"shapes \(B, C\) and \(T, C\), got \(4, 5\) and \(20, 4\)"):
        ClsRetriever()(query, index._replace(template_cls=index.template_cls[:, :4]))
    with pytest.raises(ValueError, match=r"must have shape \(M, 6\), got \(211, 5\)"):
        PatchVoteRetriever()(query, index._replace(descriptors=index.descriptors[:, :5]))
    with pytest.raises(ValueError, match=r"query.valid must have shapes"):
        PatchVoteRetriever()(query._replace(valid=query.valid[:, :4]), index)
    for make in (ClsRetriever, PatchVoteRetriever):
        with pytest.raises(ValueError, match="num_templates must be at least 1, got 0"):
            make(num_templates=0)
    with pytest.raises(ValueError, match="chunk must be at least 1, got 0"):
        PatchVoteRetriever(chunk=0)

"""Gradients of bags of words, retrieval and the templates' patches."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from foundpose.features import PcaProjection
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from foundpose.retrieval.base import QueryPatches
from foundpose.retrieval.bow import (
    SoftAssignBow,
    WordAssignment,
    assign_words,
    inverse_document_frequency,
    tf_idf,
    word_counts,
)
from foundpose.retrieval.retriever import TemplateRetriever, normalize_rows, select_templates

CROPS, PATCHES, WORDS, CHANNELS, TEMPLATES = 3, 6, 7, 4, 5
BOW = SoftAssignBow(sigma=1.0, num_nearest=3, normalization="cosine")


class Index(NamedTuple):
    words: Tensor
    idf: Tensor
    template_bow: Tensor


def randn(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def problem() -> tuple[Tensor, Tensor, Index]:
    """Descriptors, their mask (the last crop has no patch), and templates; all want gradients."""
    descriptors = randn(CROPS, PATCHES, CHANNELS, seed=0).requires_grad_()
    valid = torch.rand(CROPS, PATCHES, generator=torch.Generator().manual_seed(1)) < 0.7
    valid[-1] = False
    template_bow = normalize_rows(randn(TEMPLATES, WORDS, seed=2).abs())
    tensors = (randn(WORDS, CHANNELS, seed=3), randn(WORDS, seed=4).abs(), template_bow)
    return descriptors, valid, Index(*(t.requires_grad_() for t in tensors))


def query(descriptors: Tensor, valid: Tensor) -> QueryPatches:
    return QueryPatches(descriptors, torch.zeros(*descriptors.shape[:2], 2), valid)


def kept_similarity(descriptors: Tensor, valid: Tensor, index: Index, num_templates: int = 3) -> Tensor:
    result = TemplateRetriever(BOW, num_templates)(query(descriptors, valid), index)
    return result.similarity[result.valid]


def test_similarity_to_everything_it_depends_on() -> None:
    descriptors, valid, index = problem()
    inputs = (descriptors, *index)
    # 4 of 5 templates are kept: the choice is part of what is differentiated, and away from ties.
    assert gradcheck(lambda x, *tensors: kept_similarity(x, valid, Index(*tensors), 4), inputs)
    # More templates asked for than there are.
    assert gradcheck(lambda x: kept_similarity(x, valid, index, TEMPLATES + 2), (descriptors,))


def test_patches_outside_the_mask_have_no_gradient() -> None:
    descriptors, valid, index = problem()
    gradients = torch.autograd.grad(
        kept_similarity(descriptors, valid, index).sin().sum(), (descriptors, *index)
    )
    assert all(torch.isfinite(g).all() for g in gradients)
    assert all(g.abs().max() > 0 for g in gradients)
    assert (gradients[0][~valid] == 0).all()
    assert (gradients[0][:-1].abs().amax(dim=(1, 2)) > 0).all()


def test_gradients_do_not_depend_on_neighbours() -> None:
    descriptors, valid, index = problem()
    together = torch.autograd.grad(
        kept_similarity(descriptors, valid, index).sin().sum(), (descriptors, *index)
    )
    sums = [torch.zeros_like(t) for t in together]
    for b in range(CROPS):
        one = descriptors[b : b + 1].detach().requires_grad_()
        loss = kept_similarity(one, valid[b : b + 1], index).sin().sum()
        alone = torch.autograd.grad(loss, (one, *index))
        sums[0][b] = alone[0][0]
        for s, gradient in zip(sums[1:], alone[1:], strict=True):
            s += gradient
    for s, gradient in zip(sums, together, strict=True):
        torch.testing.assert_close(s, gradient, rtol=1e-10, atol=1e-14)


def test_descriptors_on_top_of_words() -> None:
    """The weights depend on squared distances, so they are smooth where a distance is zero."""
    _, _, index = problem()
    valid = torch.ones(1, WORDS, dtype=torch.bool)
    on_words = index.words.detach().clone()[None].requires_grad_()
    assert gradcheck(lambda x, w: BOW(x, valid, w, index.idf.detach()), (on_words, index.words))


def test_far_descriptors_and_a_small_sigma_are_finite() -> None:
    descriptors, valid, index = problem()
    single = Index(*(t.detach().float().requires_grad_() for t in index))
    for scale, sigma in ((1e6, 10.0), (1.0, 1e-3), (40.0, 10.0)):
        x = (scale * descriptors.detach().float()).requires_grad_()
        vectors = SoftAssignBow(sigma)(x, valid, single.words, single.idf)
        for gradient in torch.autograd.grad(
            normalize_rows(vectors).sin().sum(), (x, single.words, single.idf)
        ):
            assert torch.isfinite(gradient).all()


def test_frequencies_of_absent_words_and_empty_crops() -> None:
    valid = torch.tensor([[True] * 4, [True, True, False, False], [False] * 4])
    word = torch.randint(
        WORDS - 1, (3, 4, 2), generator=torch.Generator().manual_seed(5)
    )  # the last is absent
    weight = torch.rand(3, 4, 2, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    weight = (weight * valid[..., None]).requires_grad_()

    def vectors(w: Tensor, mode: str) -> Tensor:
        assignment = WordAssignment(word, w * valid[..., None])
        idf = inverse_document_frequency(assignment, valid, WORDS, mode)
        return tf_idf(word_counts(assignment, WORDS), idf)

    for mode in ("occurrence", "document"):
        assert gradcheck(lambda w, mode=mode: vectors(w, mode), (weight,))
    idf = inverse_document_frequency(WordAssignment(word, weight), valid, WORDS, "document")
    assert not idf.requires_grad
    counts = torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(tf_idf(counts, torch.ones(3).double()).sum(), counts)
    assert torch.isfinite(gradient).all()


def test_only_weights_carry_the_assignment() -> None:
    descriptors, valid, index = problem()
    assignment = assign_words(descriptors, valid, index.words, 1.0, 3)
    assert assignment.weight.requires_grad
    assert gradcheck(lambda x, w: assign_words(x, valid, w, 1.0, 3).weight, (descriptors, index.words))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_rows_have_zero_gradient(dtype: torch.dtype) -> None:
    rows = randn(3, 4, seed=7).to(dtype)
    rows[1] = 0.0
    rows.requires_grad_()
    normalized = normalize_rows(rows)
    assert (normalized[1] == 0).all()
    (gradient,) = torch.autograd.grad((normalized * torch.arange(1.0, 5.0)).sum(), rows)
    assert (gradient[1] == 0).all()
    assert (gradient[[0, 2]].abs().amax(1) > 0).all()
    assert gradcheck(normalize_rows, (rows.detach()[[0, 2]].double().requires_grad_(),))


def test_selection_passes_gradients_to_what_it_keeps_only() -> None:
    similarity = torch.tensor([[0.1, 0.9, 0.5], [0.3, 0.2, 0.1]], dtype=torch.float64, requires_grad=True)
    result = select_templates(similarity, torch.tensor([True, False]), 2)
    weights = torch.tensor([[2.0, 3.0], [5.0, 7.0]], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((result.similarity.nan_to_num(neginf=0.0) * weights).sum(), similarity)
    assert gradient.tolist() == [[0.0, 2.0, 3.0], [0.0, 0.0, 0.0]]


def representation() -> ObjectRepresentation:
    """Four templates with 2, 0, 3 and 1 patches."""
    info = RepresentationInfo("toy", 1.0, "", {}, image_size=56, stride=14.0, offset=6.5, grid=4)
    return ObjectRepresentation(
        PcaProjection(2).double(),
        words=randn(5, 2, seed=0),
        idf=torch.ones(5).double(),
        template_bow=torch.ones(4, 5).double(),
        descriptors=randn(6, 2, seed=1),
        points_model=randn(6, 3, seed=2),
        patch_index=torch.arange(6),
        template_offsets=torch.tensor([0, 2, 2, 5, 6]),
        T_template_from_model=torch.eye(4).repeat(4, 1, 1).double(),
        K_template=torch.eye(3).repeat(4, 1, 1).double(),
        template_cls=None,
        info=info,
    )


def test_gathered_patches_pass_gradients_to_their_rows_and_padding_to_none() -> None:
    r = representation()
    r.descriptors.requires_grad_()
    r.points_model.requires_grad_()
    # Template 3 twice, template 1 (empty) once, template 2 never; the loss weighs padding as well.
    patches = r.gather_templates(torch.tensor([[3, 0], [1, 3]]))
    weight_d, weight_x = randn(2, 2, 3, 2, seed=3), randn(2, 2, 3, 3, seed=4)
    loss = (patches.descriptors * weight_d).sum() + (patches.points_model * weight_x).sum()
    gradients = torch.autograd.grad(loss, (r.descriptors, r.points_model))
    for gradient, weight in zip(gradients, (weight_d, weight_x), strict=True):
        expected = torch.zeros_like(gradient)
        expected[:2] = weight[0, 1, :2]
        expected[5] = weight[0, 0, 0] + weight[1, 1, 0]
        torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-15)
    assert not patches.pixels.requires_grad

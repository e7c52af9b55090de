from types import SimpleNamespace

import pytest
import torch

from foundpose.retrieval import ObjectIndex


def with_tokens(tokens, name):
    """As much of an object's representation as the index looks at."""
    return SimpleNamespace(template_cls=tokens, info=SimpleNamespace(name=name))


@pytest.fixture
def index(generator):
    tokens = [torch.randn(6, 8, generator=generator) for _ in range(3)]
    return ObjectIndex.of([with_tokens(t, f"object {i}") for i, t in enumerate(tokens)], num_best=2)


def test_ranks_equal_a_loop(index, generator):
    cls = torch.randn(5, 8, generator=generator)
    found = index(cls, count=3)
    for b in range(5):
        similarity = [torch.cosine_similarity(cls[b], tokens, dim=-1) for tokens in index.tokens]
        means = torch.stack([each.sort().values[-2:].mean() for each in similarity])
        torch.testing.assert_close(found.score[b], means.sort(descending=True).values)
        assert found.object_index[b].tolist() == means.argsort(descending=True).tolist()
    alone = index(cls[3:4], count=3)
    assert alone.object_index.tolist() == found.object_index[3:4].tolist()


def test_file_is_mapped_and_the_same(index, tmp_path, generator):
    path = tmp_path / "index.safetensors"
    index.save(path)
    again = ObjectIndex.load(path)
    assert (again.names, again.num_best) == (["object 0", "object 1", "object 2"], 2)
    cls = torch.randn(2, 8, generator=generator)
    assert torch.equal(again(cls).score, index(cls).score)


def test_bad_input(index):
    with pytest.raises(ValueError, match=r"cls must have shape \(B, 8\), got \(2, 7\)"):
        index(torch.zeros(2, 7))
    with pytest.raises(ValueError, match="has no cls tokens"):
        ObjectIndex.of([with_tokens(None, "cup")])
    with pytest.raises(ValueError, match=r"equally many templates, got \[4, 6\]"):
        ObjectIndex.of([with_tokens(torch.randn(count, 8), "cup") for count in (4, 6)])
    with pytest.raises(ValueError, match="num_best must lie between 1 and 6, got 7"):
        ObjectIndex(index.tokens, index.names, 7)

import pytest
import torch

from foundpose.features.pca import CovarianceAccumulator, PcaProjection
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from foundpose.retrieval import QueryPatches, SoftAssignBow, SpatialReranker, TemplateRetriever
from foundpose.retrieval.base import RetrievedTemplates, Retriever

GRID, STRIDE, OFFSET, D = 12, 14.0, 6.5, 8


def pixels_of(cells):
    return torch.stack([cells % GRID, cells // GRID], dim=-1) * STRIDE + OFFSET


class AllTemplates(Retriever):
    """Candidates in their order."""

    def forward(self, query, index):
        shape = (len(query.valid), self.num_templates)
        order = torch.arange(self.num_templates).expand(shape)
        return RetrievedTemplates(order, torch.zeros(shape).to(query.descriptors), torch.ones(shape).bool())


def make_object(count=6, seed=0):
    """Templates whose patches have random descriptors in random cells."""
    g = torch.Generator().manual_seed(seed)
    cells, descriptors, counts = [], [], []
    for _ in range(count):
        n = int(torch.randint(15, 40, (1,), generator=g))
        cells.append(torch.randperm(GRID * GRID, generator=g)[:n].sort().values)
        descriptors.append(torch.randn(n, D, generator=g, dtype=torch.float64))
        counts.append(n)
    counts = torch.tensor(counts)
    total = int(counts.sum())
    samples = CovarianceAccumulator(D)
    samples.update(torch.randn(50, D, generator=g, dtype=torch.float64))
    return ObjectRepresentation(
        projection=PcaProjection(D).double().fit(samples),
        words=torch.randn(10, D, generator=g, dtype=torch.float64),
        idf=torch.ones(10).double(),
        template_bow=torch.rand(count, 10, generator=g, dtype=torch.float64),
        descriptors=torch.cat(descriptors),
        points_model=torch.randn(total, 3, generator=g, dtype=torch.float64),
        patch_index=torch.cat(cells).to(torch.int16),
        template_offsets=torch.cat([counts.new_zeros(1), counts.cumsum(0)]),
        T_template_from_model=torch.eye(4).double().expand(count, 4, 4).clone(),
        K_template=torch.eye(3).double().expand(count, 3, 3).clone(),
        template_cls=None,
        info=RepresentationInfo("thing", 1.0, "", {}, 168, STRIDE, OFFSET, GRID),
    )


def query_like(representation, templates, noise=0.2, move=lambda x: x, drop=0.0):
    """Crops that show templates, moved, with noise, and some patches missing."""
    g = torch.Generator().manual_seed(5)
    patches = representation.gather_templates(torch.tensor(templates))
    valid = patches.valid & (torch.rand(patches.valid.shape, generator=g) >= drop)
    order = (~valid).to(torch.uint8).argsort(dim=1, stable=True)
    x = patches.descriptors + noise * torch.randn(patches.descriptors.shape, generator=g, dtype=torch.float64)
    return QueryPatches(
        torch.take_along_dim(x, order[..., None], 1),
        torch.take_along_dim(move(patches.pixels), order[..., None], 1),
        valid.gather(1, order),
    )


def by_loops(query, representation, weight):
    """The score without alignment, patch by patch."""
    scores = torch.empty(len(query.valid), representation.num_templates).double()
    for b in range(len(query.valid)):
        for t in range(representation.num_templates):
            first, last = representation.template_offsets[t : t + 2].tolist()
            total, count = 0.0, 0
            for p in range(query.valid.shape[1]):
                if not query.valid[b, p]:
                    continue
                q, best = query.descriptors[b, p], -float("inf")
                for j in range(first, last):
                    r = representation.descriptors[j]
                    cosine = float(q @ r / (q.norm() * r.norm()))
                    away = (query.pixels[b, p] - pixels_of(representation.patch_index[j].long())).norm()
                    best = max(best, cosine - weight * float(away) / STRIDE)
                total, count = total + best, count + 1
            scores[b, t] = total / count
    return scores


def reranker(representation, keep=3, **settings):
    settings = {"max_patches": None, "components": None} | settings
    return SpatialReranker(AllTemplates(representation.num_templates), keep, **settings)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_equals_a_scalar_loop(weight):
    representation = make_object()
    query = query_like(representation, [0, 3, 5], noise=1.0, drop=0.3)
    expected = by_loops(query, representation, weight)
    found = reranker(representation, position_weight=weight, alignment="none")(query, representation)
    best = expected.sort(dim=1, descending=True)
    assert torch.equal(found.index, best.indices[:, :3])
    torch.testing.assert_close(found.similarity, best.values[:, :3], atol=1e-9, rtol=0)


MOVES = {
    "shift": lambda x: x + 14.0 * torch.tensor([0.7, -0.4]).double(),
    "scale": lambda x: 1.15 * (x - 80.0) + 84.0,
    "similarity": lambda x: (x - 80.0) @ torch.tensor([[0.98, 0.2], [-0.2, 0.98]]).double() + 80.0,
}


@pytest.mark.parametrize("alignment", list(MOVES))
def test_is_invariant_to_what_may_move(alignment):
    representation = make_object()
    still = query_like(representation, [1, 4], noise=0.1)
    moved = query_like(representation, [1, 4], noise=0.1, move=MOVES[alignment])
    aligned = reranker(representation, alignment=alignment)
    before, after = aligned(still, representation), aligned(moved, representation)
    assert torch.equal(after.index[:, 0], torch.tensor([1, 4]))
    torch.testing.assert_close(after.similarity[:, 0], before.similarity[:, 0], atol=0.02, rtol=0)
    stiff = reranker(representation, alignment="none")(moved, representation)
    assert (stiff.similarity[:, 0] < after.similarity[:, 0] - 0.05).all()


def test_batch_independence_and_padding():
    representation = make_object()
    query = query_like(representation, [0, 1, 2, 3, 4, 5], noise=0.8, drop=0.4)
    method = reranker(representation, max_patches=12, components=5)
    together = method(query, representation)
    for b in range(6):
        alone = QueryPatches(*(None if x is None else x[b : b + 1] for x in query))
        n = int(alone.valid.sum())
        short = alone._replace(
            descriptors=alone.descriptors[:, :n], pixels=alone.pixels[:, :n], valid=alone.valid[:, :n]
        )
        for one in (method(alone, representation), method(short, representation)):
            assert torch.equal(one.index[0], together.index[b])
            torch.testing.assert_close(one.similarity[0], together.similarity[b], atol=1e-10, rtol=0)


def test_a_crop_without_patches_has_no_templates():
    representation = make_object()
    query = query_like(representation, [0, 1])
    query.valid[1] = False
    method = SpatialReranker(TemplateRetriever(SoftAssignBow(1.0), 6), 3)
    found = method(query, representation)
    assert found.valid[0].all()
    assert not found.valid[1].any()
    assert found.index[0, 0] == 0
    assert found.similarity.dtype == torch.float64


def test_similarity_has_the_gradient_of_finite_differences():
    representation = make_object(3)
    query = query_like(representation, [0], noise=0.5)

    def similarity(x):
        return reranker(representation, 2, alignment="none")(
            query._replace(descriptors=x), representation
        ).similarity

    assert torch.autograd.gradcheck(similarity, [query.descriptors.clone().requires_grad_()])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"position_weight": -0.1}, "position_weight must not be negative, got -0.1"),
        ({"alignment": "affine"}, "got 'affine'"),
        ({"num_templates": 9}, "finds 6 candidates, of which 9"),
        ({"max_patches": 0}, "max_patches must be at least 1 or None, got 0"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        SpatialReranker(AllTemplates(6), **settings)

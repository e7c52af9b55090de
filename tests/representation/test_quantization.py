"""Codes of descriptors: how exact they are, how they are kept, and what they change."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from sklearn.cluster import KMeans

from foundpose.onboarding import Onboarder
from foundpose.representation import ObjectRepresentation
from foundpose.representation.quantization import (
    ProductCodec,
    ScalarCodec,
    balanced_groups,
    codec_from_state,
    compress,
)
from foundpose.retrieval import PatchVoteRetriever, QueryPatches, SoftAssignBow, TemplateRetriever
from tests.onboarding.test_onboarder import make_onboarder


def correlated(count: int = 3000, d: int = 16, seed: int = 0) -> torch.Tensor:
    """Descriptors as PCA leaves them: channels of falling variance that are uncorrelated but not independent."""
    g = torch.Generator().manual_seed(seed)
    centres = torch.randn(40, d, generator=g, dtype=torch.float64)
    x = centres[torch.randint(40, (count,), generator=g)]
    x = x + 0.3 * torch.randn(count, d, generator=g, dtype=torch.float64)
    return (x * torch.logspace(1, -2, d, dtype=torch.float64) + 5.0).float()


def squared_error(x: torch.Tensor, storage: str, subspaces: int = 4) -> float:
    codes, codec = compress(x, storage, subspaces)
    return float((codec.decode(codes) - x).double().square().sum())


def test_int8_errs_by_half_a_step_at_most() -> None:
    x = correlated().clamp(-20, 25)
    codes, codec = compress(x, "int8")
    assert codes.dtype == torch.uint8
    assert codes.shape == x.shape
    # Without outliers nothing is gained by clipping, and every level of every channel is of use.
    inside = (codes > 0) & (codes < 255)
    assert inside.float().mean() > 0.98
    error = (codec.decode(codes) - x).abs()
    assert (error <= codec.scale * 0.501 + 1e-6)[inside].all()
    full = (x.amax(0) - x.amin(0)) / 255
    assert (codec.scale <= full * 1.001).all()
    # The error of a uniform quantiser.
    assert (codec.decode(codes) - x).square().mean(0).sum() <= 1.05 * full.square().sum() / 12


def test_int8_learns_to_clip_outliers() -> None:
    x = correlated(20_000)
    x[::4000, :3] *= 300.0
    codes, codec = compress(x, "int8")
    usual = torch.ones(len(x), dtype=torch.bool)
    usual[::4000] = False
    full = (x.amax(0) - x.amin(0)) / 255
    learned = (codec.decode(codes) - x).square().sum()
    level = ((x - x.amin(0)) / full).round()
    whole = (level * full + x.amin(0) - x).square().sum()
    assert learned <= whole
    # Of the candidates per channel none is better.
    for share in (1.0, 0.5, 0.25):
        step = full * share
        start = (x.amin(0) + x.amax(0)) / 2 - step * 127.5
        other = ((x - start) / step).round().clamp(0, 255) * step + start
        assert ((codec.decode(codes) - x).square().sum(0) <= (other - x).square().sum(0) * 1.02 + 1e-6).all()


def test_constant_channels_and_few_descriptors_are_kept_exactly() -> None:
    x = correlated(100)
    x[:, 3] = 7.25
    x[:, 5] = 0.0
    codes, codec = compress(x, "int8")
    assert torch.equal(codec.decode(codes)[:, [3, 5]], x[:, [3, 5]])
    codes, codec = compress(x, "pq", 4)
    # A centroid for each of the 100.
    assert torch.equal(codec.decode(codes), x)
    assert codec.centroids.shape == (4, 256, 4)


def test_product_quantisation_equals_sklearn_group_by_group() -> None:
    x = correlated(6000)
    codes, codec = compress(x, "pq", 4)
    assert codes.shape == (6000, 4)
    assert codec.channels.flatten().sort().values.tolist() == list(range(16))
    decoded = codec.decode(codes)
    for group, centroids, code in zip(codec.channels, codec.centroids, codes.T, strict=True):
        part = x[:, group]
        # Each code names the nearest centroid.
        distance = torch.cdist(part.double(), centroids.double())
        best = distance.amin(dim=1)
        torch.testing.assert_close(distance.gather(1, code.long()[:, None])[:, 0], best, rtol=1e-3, atol=1e-4)
        assert torch.equal(decoded[:, group], centroids[code.long()])
        reference = KMeans(256, n_init=1, max_iter=100, random_state=0).fit(part.numpy())
        # Which of the local minima is found differs.
        assert float(best.square().sum()) < 1.2 * reference.inertia_


def test_balanced_groups_halve_the_error_of_neighbouring_channels() -> None:
    x = correlated(6000)
    neighbours = torch.arange(16).reshape(4, 4)
    total = 0.0
    for group in neighbours:
        total += KMeans(256, n_init=1, random_state=0).fit(x[:, group].numpy()).inertia_
    assert squared_error(x, "pq") < 0.5 * total


def test_groups_have_about_equal_products_of_variances() -> None:
    variance = torch.logspace(2, -5, 64, dtype=torch.float64)
    groups = balanced_groups(variance, 8)
    assert groups.shape == (8, 8)
    assert sorted(groups.flatten().tolist()) == list(range(64))
    product = variance.log()[groups].sum(dim=1)
    neighbours = variance.log().reshape(8, 8).sum(dim=1)
    assert product.std() < 0.05 * neighbours.std()
    # The unit of the descriptors does not matter, and channels without variance do no harm.
    for unit in (1e-6, 1e6):
        product = variance.log()[balanced_groups(variance * unit, 8)].sum(dim=1)
        assert product.std() < 0.05 * neighbours.std()
    dead = torch.cat([variance[:32], torch.zeros(32, dtype=torch.float64)])
    assert balanced_groups(dead, 8).lt(32).sum(dim=1).max() <= 8
    assert sorted(balanced_groups(torch.zeros(8), 4).flatten().tolist()) == list(range(8))


def test_more_bytes_err_less() -> None:
    x = correlated(2000)
    errors = [squared_error(x, "pq", n) for n in (1, 2, 4, 8)] + [squared_error(x, "int8")]
    assert errors[:4] == sorted(errors[:4], reverse=True)
    assert errors[3] < 0.1 * errors[0]
    assert errors[4] < errors[2]


def test_the_same_seed_gives_the_same_codes_whatever_the_number_of_threads() -> None:
    x = correlated(1000)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append([compress(x, storage, 4) for storage in ("int8", "pq")])
    finally:
        torch.set_num_threads(threads)
    for (codes, codec), (again, other) in zip(*results, strict=True):
        assert (codes == again).float().mean() > 0.999
        for a, b in zip(codec.state_dict().values(), other.state_dict().values(), strict=True):
            torch.testing.assert_close(a, b)
    other_seed, _ = compress(x, "pq", 4, seed=1)
    assert (other_seed != results[0][1][0]).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_codecs_work_in_both_precisions_and_shapes(dtype: torch.dtype) -> None:
    x = correlated().to(dtype)
    for storage in ("int8", "pq"):
        codes, codec = compress(x, storage, 4)
        assert codes.dtype == torch.uint8
        y = codec.decode(codes[:24].reshape(2, 3, 4, -1))
        assert y.shape == (2, 3, 4, 16)
        assert y.dtype == dtype
        assert torch.equal(y.reshape(24, 16), codec.decode(codes[:24]))
        again = codec_from_state(codec.state_dict())
        assert torch.equal(again.decode(codes), codec.decode(codes))
        assert torch.equal(again.encode(x), codes)


def test_decoding_has_gradients_of_the_codebooks() -> None:
    x = correlated(600).double()
    codes, scalar = compress(x, "int8")
    codes = codes[:7]
    assert torch.autograd.gradcheck(
        lambda s, o: ScalarCodec(s, o).decode(codes),
        (scalar.scale.requires_grad_(), scalar.offset.requires_grad_()),
    )
    codes, product = compress(x, "pq", 4)
    leaf = product.centroids.clone().requires_grad_()
    ProductCodec(leaf, product.channels).decode(codes[:7]).sum().backward()
    used = torch.zeros(4, 256, dtype=torch.bool)
    used[torch.arange(4), codes[:7].long()] = True
    assert torch.equal(leaf.grad.ne(0).any(dim=2), used)


def test_bad_input() -> None:
    x = correlated(300)
    with pytest.raises(ValueError, match=r"storage must be one of .*'pq'\), got 'int4'"):
        compress(x, "int4")
    with pytest.raises(
        ValueError, match="must divide the descriptors' 16 components, got 5; take for example 16"
    ):
        compress(x, "pq", 5)
    with pytest.raises(ValueError, match="pq_subspaces must divide"):
        make_onboarder(storage="pq", pq_subspaces=7)
    x[7, 3] = torch.nan
    for storage in ("int8", "pq"):
        with pytest.raises(ValueError, match="all of them finite"):
            compress(x, storage, 4)
    with pytest.raises(ValueError, match=r"scale and offset .* got \(3,\) and \(4,\)"):
        ScalarCodec(torch.ones(3), torch.ones(4))
    with pytest.raises(ValueError, match="centroids and channels must have shapes"):
        ProductCodec(torch.ones(4, 16, 2), torch.zeros(4, 2))
    with pytest.raises(ValueError, match="no descriptor codec consists of"):
        codec_from_state({"scale": torch.ones(3)})


@pytest.fixture(scope="module", params=["int8", "pq"])
def stored(request, oracle_blob: ObjectRepresentation) -> ObjectRepresentation:
    """As `oracle_blob`, with codes."""
    return oracle_blob.with_storage(request.param, 16)


def test_a_representation_of_codes(oracle_blob, stored, tmp_path) -> None:
    full, less = oracle_blob.memory_bytes(), stored.memory_bytes()
    width = stored.descriptors.shape[1]
    assert less["descriptors"] == len(oracle_blob.descriptors) * width
    assert full["descriptors"] / less["descriptors"] == 64 * 4 / width
    assert less["codec"] == sum(t.nbytes for t in stored.codec.state_dict().values())
    assert less["total"] == sum(size for part, size in less.items() if part != "total")
    assert less["template_bow"] == full["template_bow"]
    assert stored.info.settings["storage"] == ("int8" if width == 64 else "pq")
    # Only what is gathered is decoded, and it is close.
    index = torch.tensor([[3, 0], [99, 3]])
    a, b = oracle_blob.gather_templates(index), stored.gather_templates(index)
    assert torch.equal(a.valid, b.valid)
    assert torch.equal(a.points_model, b.points_model)
    assert torch.equal(a.pixels, b.pixels)
    assert b.descriptors.dtype == torch.float32
    assert (b.descriptors[~b.valid] == 0).all()
    spread = (oracle_blob.descriptors - oracle_blob.descriptors.mean(0)).norm(dim=1).mean()
    assert (a.descriptors - b.descriptors).norm(dim=-1)[a.valid].mean() < 0.03 * spread
    row = int(stored.template_offsets[99])
    assert torch.equal(b.descriptors[1, 0, 0], stored.codec.decode(stored.descriptors[row]))
    # In a file, on the way back, and as a whole in half precision.
    path = tmp_path / "blob.safetensors"
    stored.save(path)
    assert path.stat().st_size == pytest.approx(less["total"], rel=0.01)
    for mmap in (True, False):
        again = ObjectRepresentation.load(path, mmap=mmap)
        assert again.info == stored.info
        for name, tensor in stored.state_dict().items():
            assert torch.equal(tensor, again.state_dict()[name]), name
        assert torch.equal(again.gather_templates(index).descriptors, b.descriptors)
    halved = ObjectRepresentation.load(path).half()
    assert halved.descriptors.dtype == torch.uint8
    half = halved.gather_templates(index).descriptors
    assert half.dtype == torch.float16
    torch.testing.assert_close(half.float(), b.descriptors, rtol=0.02, atol=0.02)


def test_files_that_lack_the_codec_are_refused(stored, tmp_path) -> None:
    path = tmp_path / "blob.safetensors"
    stored.save(path)
    whole = load_file(path)
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    save_file({k: t for k, t in whole.items() if not k.startswith("codec.")}, path, metadata)
    with pytest.raises(
        ValueError, match=r"blob.safetensors: .* codes need the codec .*; onboard the object again"
    ):
        ObjectRepresentation.load(path)
    dropped = next(k for k in whole if k.startswith("codec."))
    save_file({k: t for k, t in whole.items() if k != dropped}, path, metadata)
    with pytest.raises(ValueError, match=r"no descriptor codec consists of .*; onboard the object again"):
        ObjectRepresentation.load(path)
    with pytest.raises(ValueError, match=r"codes \(.*Codec\) already; convert the representation with"):
        stored.with_storage("float16")


def test_onboarding_with_a_storage_is_onboarding_and_then_storing_so(blob) -> None:
    stages: list[str] = []
    plain = make_onboarder()(blob, "blob")
    for storage in ("float16", "int8", "pq"):
        onboarder: Onboarder = make_onboarder(storage=storage, pq_subspaces=8)
        assert onboarder.settings()["storage"] == storage
        assert ("pq_subspaces" in onboarder.settings()) == (storage == "pq")
        direct = onboarder(blob, "blob", lambda stage, *_: stages.append(stage))
        expected = plain.with_storage(storage, 8)
        assert direct.info == expected.info
        for name, tensor in expected.state_dict().items():
            assert torch.equal(tensor, direct.state_dict()[name]), name
    assert "storage" in stages


def make_query(representation: ObjectRepresentation, templates: torch.Tensor) -> QueryPatches:
    """Crops that look like templates, with noise."""
    patches = representation.gather_templates(templates)
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(patches.descriptors.shape, generator=g)
    scale = representation.descriptors.std()
    return QueryPatches(patches.descriptors + 0.3 * scale * noise, patches.pixels, patches.valid)


def test_bags_of_words_retrieve_the_same_and_votes_hardly_change(oracle_blob, stored) -> None:
    templates = torch.arange(0, 100, 7)
    query = make_query(oracle_blob, templates)
    words = TemplateRetriever(SoftAssignBow(), num_templates=5)
    a, b = words(query, oracle_blob), words(query, stored)
    assert torch.equal(a.index, b.index)
    assert torch.equal(a.similarity, b.similarity)
    votes = PatchVoteRetriever(5)
    a, b = votes(query, oracle_blob), votes(query, stored)
    assert torch.equal(a.index[:, 0], b.index[:, 0])
    torch.testing.assert_close(a.similarity, b.similarity, rtol=0, atol=0.01)
    # They read codes by decoding all of them, block by block.
    decoded = ObjectRepresentation(
        **{
            name: tensor
            for name, tensor in stored.state_dict().items()
            if not name.startswith(("projection", "codec", "descriptors"))
        },
        descriptors=stored.codec.decode(stored.descriptors),
        projection=stored.projection,
        template_cls=None,
        info=stored.info,
    )
    c = votes(query, decoded)
    assert torch.equal(b.index, c.index)
    torch.testing.assert_close(b.similarity, c.similarity)
    # Gradients reach the query, as before.
    leaf = query.descriptors.clone().requires_grad_()
    votes(query._replace(descriptors=leaf), stored).similarity.sum().backward()
    assert leaf.grad.abs().max() > 0
    with pytest.raises(ValueError, match=r"must have shape \(M, 5\), got \(200, 64\)"):
        votes(query._replace(descriptors=query.descriptors[..., :5]), stored)


def test_most_matches_stay(oracle_blob, stored) -> None:
    templates = torch.arange(0, 100, 9)
    query = make_query(oracle_blob, templates)
    nearest = []
    for representation in (oracle_blob, stored):
        patches = representation.gather_templates(templates)
        distance = torch.cdist(query.descriptors, patches.descriptors)
        nearest.append(distance.masked_fill(~patches.valid.unsqueeze(1), np.inf).argmin(dim=2))
    same = (nearest[0] == nearest[1])[query.valid].float().mean()
    assert same > (0.98 if isinstance(stored.codec, ScalarCodec) else 0.9)

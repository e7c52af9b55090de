import io
import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA

from foundpose.features.pca import CovarianceAccumulator, PcaProjection, principal_components


def samples(
    count: int, channels: int, dtype: torch.dtype = torch.float64, offset: float = 20.0
) -> torch.Tensor:
    g = torch.Generator().manual_seed(count + channels)
    mixing = torch.randn(channels, channels, generator=g, dtype=torch.float64)
    spectrum = 4.0 / torch.arange(1, channels + 1, dtype=torch.float64)
    x = torch.randn(count, channels, generator=g, dtype=torch.float64) * spectrum
    return (x @ torch.linalg.qr(mixing).Q + offset).to(dtype)


def fitted(x: torch.Tensor, num_components: int) -> PcaProjection:
    return PcaProjection(num_components).to(x.dtype).fit(CovarianceAccumulator(x.shape[1]).update(x))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_sklearn(dtype: torch.dtype) -> None:
    x = samples(3000, 96, dtype)
    accumulator = CovarianceAccumulator(96)
    for batch in x.split([1, 0, 700, 37, 2262]):
        accumulator.update(batch)
    pca = PcaProjection(24).to(dtype).fit(accumulator)
    reference = PCA(24, svd_solver="full").fit(x.double().numpy())
    expected = torch.from_numpy(reference.components_)
    signs = (pca.components.double() * expected).sum(1).sign()
    torch.testing.assert_close(pca.components.double(), expected * signs[:, None], atol=1e-4, rtol=0)
    torch.testing.assert_close(
        pca.explained_variance.double(), torch.from_numpy(reference.explained_variance_), atol=0, rtol=1e-4
    )
    projected = torch.from_numpy(reference.transform(x.double().numpy())) * signs
    torch.testing.assert_close(pca(x).double(), projected, atol=1e-4, rtol=1e-4)


def test_signs_are_deterministic_and_rows_orthonormal() -> None:
    x = samples(500, 32)
    pca = fitted(x, 32)
    largest = pca.components.gather(1, pca.components.abs().argmax(1, keepdim=True))
    assert (largest > 0).all()
    torch.testing.assert_close(pca.components @ pca.components.T, torch.eye(32, dtype=torch.float64))
    # The order of the samples changes the rounding only, never a sign.
    shuffled = fitted(x[torch.randperm(500, generator=torch.Generator().manual_seed(1))], 32)
    torch.testing.assert_close(shuffled.components, pca.components, atol=1e-6, rtol=0)


@settings(max_examples=30, deadline=None)
@given(cuts=st.lists(st.integers(0, 200), max_size=6), offset=st.sampled_from([0.0, 1e3, 1e6]))
def test_accumulator_does_not_depend_on_batching(cuts: list[int], offset: float) -> None:
    x = samples(200, 7, offset=offset)
    bounds = [0, *sorted(cuts), 200]
    streamed = CovarianceAccumulator(7)
    for start, stop in itertools.pairwise(bounds):
        streamed.update(x[start:stop])
    assert streamed.count == 200
    torch.testing.assert_close(streamed.mean, x.mean(0), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(streamed.covariance(), torch.cov(x.T), rtol=1e-8, atol=1e-9)


def test_large_offset_in_float32_keeps_the_covariance() -> None:
    x = samples(5000, 16, torch.float32, offset=1000.0)
    accumulator = CovarianceAccumulator(16)
    for batch in x.split(100):
        accumulator.update(batch)
    torch.testing.assert_close(accumulator.covariance(), torch.cov(x.double().T), rtol=1e-10, atol=1e-10)


def test_accumulator_state_does_not_grow() -> None:
    accumulator = CovarianceAccumulator(8)
    x = samples(50, 8).requires_grad_()
    for _ in range(20):
        accumulator.update(x)
    state = [v for v in vars(accumulator).values() if isinstance(v, torch.Tensor)]
    assert sum(v.numel() for v in state) == 8 + 64
    assert all(v.grad_fn is None for v in state)


def test_no_whitening_preserves_distances_at_full_rank() -> None:
    x = samples(300, 12)
    torch.testing.assert_close(torch.pdist(fitted(x, 12)(x)), torch.pdist(x))


def test_gradients() -> None:
    x = samples(100, 6)
    pca = fitted(x, 3)
    point = x[:4].clone().requires_grad_()
    assert torch.autograd.gradcheck(pca, point)
    pca.components.requires_grad_()
    pca(point).square().sum().backward()
    assert pca.components.grad is not None
    expected = 2 * pca(point).T @ (point - pca.mean)
    torch.testing.assert_close(pca.components.grad, expected.detach())


def test_leading_shape_and_batch_independence() -> None:
    x = samples(400, 20, torch.float32)
    pca = fitted(x, 5)
    batch = pca(x[:60].reshape(3, 4, 5, 20))
    assert batch.shape == (3, 4, 5, 5)
    torch.testing.assert_close(batch[1, 2, 3], pca(x[20 + 10 + 3]), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_state_dict_round_trip_into_unfitted_module(dtype: torch.dtype) -> None:
    x = samples(200, 10, dtype)
    pca = fitted(x, 4)
    file = io.BytesIO()
    torch.save(torch.nn.Sequential(pca).state_dict(), file)
    file.seek(0)
    fresh = torch.nn.Sequential(PcaProjection(4).to(dtype))
    fresh.load_state_dict(torch.load(file))
    assert torch.equal(fresh(x), pca(x))
    with pytest.raises(ValueError, match="4 components, num_components is 5"):
        PcaProjection(5).load_state_dict(pca.state_dict())


def test_dtype_and_device_moves_survive_fitting() -> None:
    x = samples(100, 8)
    assert fitted(x, 2).mean.dtype == torch.float64
    assert fitted(x.float(), 2).components.dtype == torch.float32
    assert fitted(x, 2).half().explained_variance.dtype == torch.float16


def test_from_covariance() -> None:
    x = samples(100, 8)
    pca = PcaProjection.from_covariance(x.mean(0), torch.cov(x.T), 3)
    torch.testing.assert_close(pca.components, fitted(x, 3).components.float())


def test_bad_input() -> None:
    x = samples(100, 8)
    with pytest.raises(ValueError, match=r"\(n, 8\), got \(100, 9\)"):
        CovarianceAccumulator(8).update(samples(100, 9))
    with pytest.raises(ValueError, match="at least two samples, got 1"):
        fitted(x[:1], 1)
    with pytest.raises(ValueError, match="between 1 and the 8 channels, got 9"):
        fitted(x, 9)
    with pytest.raises(ValueError, match="num_components is 6 but there are 5 samples only"):
        fitted(x[:5], 6)
    with pytest.raises(ValueError, match="NaN"):
        fitted(x.where(x < x.max(), torch.nan), 2)
    with pytest.raises(RuntimeError, match="not fitted"):
        PcaProjection(2)(x)
    with pytest.raises(ValueError, match=r"\(\.\.\., 8\), got \(100, 7\)"):
        fitted(x, 2)(x[:, :7])
    with pytest.raises(ValueError, match=r"\(C, C\), got \(2, 3\)"):
        principal_components(torch.zeros(2, 3), 1)
    with pytest.raises(ValueError, match="all samples are the same"):
        fitted(torch.ones(50, 8, dtype=torch.float64), 1)


def test_samples_in_a_subspace_project_without_loss() -> None:
    x = samples(200, 3) @ samples(3, 8)
    pca = fitted(x, 6)
    assert (pca.explained_variance[3:] < 1e-10 * pca.explained_variance[0]).all()
    torch.testing.assert_close(pca.components @ pca.components.T, torch.eye(6, dtype=torch.float64))
    torch.testing.assert_close(torch.pdist(pca(x)), torch.pdist(x))

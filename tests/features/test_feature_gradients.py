"""Gradients of extractors, hooks and the PCA."""

import copy
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import gradcheck

from foundpose.features import CoordinateCode, DenseSift, DinoV2, FeatureHook, PatchExtractor, PcaProjection
from foundpose.features.oracle import PatchNoise
from foundpose.features.pca import CovarianceAccumulator, principal_components
from foundpose.representation import ObjectRepresentation

TINY = {"hidden_size": 32, "num_hidden_layers": 6, "num_attention_heads": 4, "image_size": 70}


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pictures(count: int, size: int) -> Tensor:
    g = torch.Generator().manual_seed(0)
    return torch.rand(count, 3, size, size, generator=g, dtype=torch.float64).requires_grad_()


def fitted(channels: int = 5, num_components: int = 3) -> PcaProjection:
    samples = randn(40, channels) * torch.arange(1, channels + 1)
    accumulator = CovarianceAccumulator(channels).update(samples)
    return PcaProjection(num_components).double().fit(accumulator)


class TestPca:
    def test_gradcheck_of_input_mean_and_components(self) -> None:
        pca = fitted().make_trainable()
        names = ("mean", "components")
        inputs = (randn(2, 4, 5, seed=1).requires_grad_(), *(getattr(pca, name) for name in names))
        assert {name for name, _ in pca.named_parameters()} == set(names)

        def project(x: Tensor, mean: Tensor, components: Tensor) -> Tensor:
            return torch.func.functional_call(pca, {"mean": mean, "components": components}, (x,))

        assert gradcheck(project, inputs)
        gradients = torch.autograd.grad(pca(inputs[0]).sin().sum(), inputs)
        assert all(g.abs().max() > 0 for g in gradients)

    def test_fitted_state_is_constant_until_asked_for(self) -> None:
        samples = randn(40, 5).requires_grad_()
        pca = PcaProjection.from_covariance(samples.mean(0), torch.cov(samples.T), 2)
        assert not list(pca.parameters())
        assert not any(b.requires_grad for b in pca.buffers())
        assert not pca(samples.detach().float()).requires_grad
        copy.deepcopy(pca)  # refuses tensors with a history

    def test_an_optimiser_trains_the_components_of_a_loaded_object(
        self, oracle_blob: ObjectRepresentation, tmp_path: Path
    ) -> None:
        oracle_blob.save(tmp_path / "before.safetensors")
        loaded = ObjectRepresentation.load(tmp_path / "before.safetensors")
        before = {name: t.clone() for name, t in loaded.state_dict().items()}
        raw = randn(200, len(loaded.projection.mean), seed=2).float()
        target = randn(200, loaded.projection.num_components, seed=3).float()
        optimizer = torch.optim.Adam(loaded.projection.make_trainable().parameters(), lr=1e-2)
        losses = []
        for _ in range(30):
            optimizer.zero_grad()
            loss = (loaded.projection(raw) - target).square().mean()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        assert losses[-1] < 0.5 * losses[0]
        trained = {"projection.mean", "projection.components"}
        assert {n for n, t in loaded.state_dict().items() if not torch.equal(t, before[n])} == trained
        # The same file format; what is read back is constant again and projects as trained.
        loaded.save(tmp_path / "after.safetensors")
        again = ObjectRepresentation.load(tmp_path / "after.safetensors")
        assert not list(again.parameters())
        assert torch.equal(again.projection(raw), loaded.projection(raw).detach())

    def test_trainable_state_survives_copies_casts_and_loading(self) -> None:
        pca = fitted().make_trainable()
        parameters = dict(pca.named_parameters())
        assert dict(pca.make_trainable().named_parameters()) == parameters  # asking twice changes nothing
        other = fitted(num_components=3)
        other.load_state_dict(pca.state_dict())
        pca.load_state_dict(other.state_dict())
        pca.float().double()
        assert all(
            parameters[name] is p for name, p in pca.named_parameters()
        )  # an optimiser's references hold
        assert len(list(copy.deepcopy(pca).parameters())) == 2
        assert not list(other.parameters())

    def test_fitting_again_gives_constants(self) -> None:
        pca = fitted().make_trainable()
        pca.fit(CovarianceAccumulator(5).update(randn(40, 5, seed=9)))
        assert not list(pca.parameters())
        assert {name for name, _ in pca.named_buffers()} == {"mean", "components", "explained_variance"}
        assert pca(randn(3, 5)).dtype == torch.float64
        assert not pca(randn(3, 5)).requires_grad

    def test_nothing_to_train_before_fitting(self) -> None:
        with pytest.raises(RuntimeError, match="PcaProjection is not fitted"):
            PcaProjection(3).make_trainable()

    def test_gradcheck_of_principal_components(self) -> None:
        root = torch.diag(torch.arange(1.0, 6.0, dtype=torch.float64)) + 0.1 * randn(5, 5)
        assert gradcheck(lambda r: principal_components(r @ r.T, 3), (root.requires_grad_(),))


@pytest.mark.parametrize(
    "extractor",
    [
        DenseSift(supports=(28.0, 42.0)),
        DenseSift(rootsift=True),
        DinoV2("vits14_reg", 2, config=TINY, weights="random", seed=0).double(),
        CoordinateCode(channels=16),
        PatchNoise(CoordinateCode(channels=16), fraction=0.5),
    ],
    ids=["sift", "rootsift", "dinov2", "code", "noise"],
)
def test_image_gradients_do_not_depend_on_neighbours(extractor: PatchExtractor) -> None:
    images = pictures(3, 56)
    weights = randn(3, *extractor(images).patches.shape[1:], seed=1)
    (together,) = torch.autograd.grad((extractor(images).patches * weights).sum(), images)
    assert torch.isfinite(together).all()
    assert (together.abs().amax(dim=(1, 2, 3)) > 0).all()
    for b in range(3):
        one = images[b : b + 1].detach().requires_grad_()
        (alone,) = torch.autograd.grad((extractor(one).patches * weights[b : b + 1]).sum(), one)
        torch.testing.assert_close(alone[0], together[b], rtol=1e-8, atol=1e-9 * float(together.abs().max()))


@pytest.mark.parametrize("rootsift", [False, True])
@pytest.mark.parametrize("contrast", [0.0, 0.01])
def test_sift_gradients_beside_flat_regions_are_finite(rootsift: bool, contrast: float) -> None:
    images = torch.zeros(2, 3, 112, 112)
    images[0, :, :, 56:] = pictures(1, 112).detach().float()[0, :, :, 56:]  # half a black background
    images[1] = 0.3  # blurring leaves rounding noise of 1e-8
    images.requires_grad_()
    patches = DenseSift(supports=(28.0,), rootsift=rootsift, contrast=contrast)(images).patches
    weights = randn(*patches.shape).float()
    (gradient,) = torch.autograd.grad((patches * weights).sum(), images)
    assert torch.isfinite(gradient).all()
    assert gradient[0, :, :, 56:].abs().max() > 0
    # A window with its blur reaches 21 pixels: those centred at 34.5 and before are black all over.
    assert (gradient[0, :, :, :27] == 0).all()
    if contrast > 0:
        assert gradient[1].abs().max() < 0.1


def test_gradcheck_of_coordinate_codes() -> None:
    # Colours far from the darkest that counts as object; patch 0 shows background.
    image = (0.3 + 0.5 * pictures(1, 28).detach()).requires_grad_()
    with torch.no_grad():
        image[:, :, :14, :14] = 0.0
    extractor = CoordinateCode(channels=8)
    assert gradcheck(lambda i: extractor(i).patches, (image,), fast_mode=True)
    (gradient,) = torch.autograd.grad(extractor(image).patches.sin().sum(), image)
    assert (gradient[:, :, :14, :14] == 0).all()
    assert gradient[:, :, 14:, 14:].abs().max() > 0


def test_noise_passes_gradients_of_the_patches_it_leaves() -> None:
    image = (0.3 + 0.5 * pictures(1, 140).detach()).requires_grad_()
    extractor = CoordinateCode(channels=8)
    noisy = PatchNoise(extractor, fraction=0.5)
    clean, disturbed = extractor(image).patches, noisy(image).patches
    kept = (clean == disturbed).all(dim=1, keepdim=True)
    assert 0 < kept.sum() < kept.numel()
    (expected,) = torch.autograd.grad((clean * kept).sin().sum(), image)
    (gradient,) = torch.autograd.grad(disturbed.sin().sum(), image)
    torch.testing.assert_close(gradient, expected)


class Blocks(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.blocks = nn.ModuleList(nn.Linear(4, 4, dtype=torch.float64) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        for block in self.blocks:
            x = block(x).tanh()
        return x


@pytest.mark.parametrize("stop", [True, False])
def test_hook_gives_the_gradients_of_the_plain_forward_pass(stop: bool) -> None:
    module = Blocks()
    hook = FeatureHook(module, "blocks.1", stop=stop)
    x = randn(3, 4).requires_grad_()
    used = [p for block in module.blocks[:2] for p in block.parameters()]
    output = hook(x)
    assert not output.is_inference()
    found = torch.autograd.grad(output.sin().sum(), (x, *used))
    plain = module.blocks[1](module.blocks[0](x).tanh())
    for gradient, expected in zip(found, torch.autograd.grad(plain.sin().sum(), (x, *used)), strict=True):
        assert torch.equal(gradient, expected)
    assert gradcheck(hook, (x,))


def test_hook_and_extractor_leave_requires_grad_alone() -> None:
    module = Blocks()
    module.blocks[0].requires_grad_(False)
    hook = FeatureHook(module, "blocks.1")
    x = randn(3, 4).requires_grad_()
    hook(x).sum().backward()
    assert x.grad is not None
    assert [p.requires_grad for p in module.parameters()] == [False] * 2 + [True] * 4
    assert module.blocks[0].weight.grad is None
    assert module.blocks[1].weight.grad is not None

    extractor = DinoV2("vits14_reg", 2, config=TINY, weights="random", seed=0)
    assert all(p.requires_grad for p in extractor.parameters())
    extractor.requires_grad_(False)
    images = pictures(1, 56).detach().float().requires_grad_()
    patches = extractor(images).patches
    assert not any(p.requires_grad for p in extractor.parameters())
    (gradient,) = torch.autograd.grad(patches.sin().sum(), images)  # a frozen backbone is not a detached one
    assert gradient.abs().max() > 0


def test_dinov2_gradients_under_autocast_are_those_of_full_precision() -> None:
    gradients = {}
    for precision in (None, "bf16"):
        extractor = DinoV2("vits14_reg", 2, precision=precision, config=TINY, weights="random", seed=0)
        images = pictures(2, 56).detach().float().requires_grad_()
        patches = extractor(images).patches
        weights = randn(*patches.shape, seed=3).float()
        (patches * weights).sum().backward()
        parameters = {n: p.grad for n, p in extractor.named_parameters() if p.grad is not None}
        assert images.grad is not None
        gradients[precision] = {"images": images.grad, **parameters}
    assert gradients[None].keys() == gradients["bf16"].keys()
    for name, exact in gradients[None].items():
        rounded = gradients["bf16"][name]
        assert rounded.dtype == torch.float32, name
        if exact.abs().max() > 1e-3:  # random biases of keys have gradients of rounding errors only
            cosine = nn.functional.cosine_similarity(exact.flatten(), rounded.flatten(), dim=0)
            assert cosine > 0.98, name
    assert gradients["bf16"]["images"].abs().max() > 1e-3

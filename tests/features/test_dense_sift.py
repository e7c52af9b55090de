import cv2
import numpy as np
import pytest
import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import SIFTDescriptor, convert_sift_descriptor_layout
from scipy import ndimage

from foundpose.features.dense_sift import DenseSift, describe_windows, sample_windows


def natural_images(count: int, size: int, seed: int = 0) -> torch.Tensor:
    """RGB images (count, 3, size, size) with the 1/f amplitude spectrum of photographs, and a few hard edges."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1.0
    noise = np.fft.fft2(rng.standard_normal((count, 3, size, size))) / frequency
    images = np.fft.ifft2(noise).real
    v, u = np.mgrid[:size, :size]
    for image in images:
        for _ in range(6):
            cu, cv, r = rng.uniform((0, 0, 0.05), (1, 1, 0.2)) * size
            image[:, np.hypot(u - cu, v - cv) < r] += rng.uniform(-1, 1) * images.std() * 2
    images = images - images.min(axis=(1, 2, 3), keepdims=True)
    return torch.from_numpy(images / images.max(axis=(1, 2, 3), keepdims=True)).float()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_shapes_and_dtypes(dtype: torch.dtype) -> None:
    images = natural_images(2, 140)
    out = DenseSift()(images.to(dtype))
    assert out.cls is None
    assert out.patches.shape == (2, 256, 10, 10)
    assert out.patches.dtype == dtype
    exact = DenseSift()(images.double()).patches
    atol = 1e-4 if dtype in (torch.float32, torch.float64) else 0.1  # half: the image itself is rounded
    torch.testing.assert_close(out.patches.double(), exact, atol=atol, rtol=0)
    assert DenseSift()(images[:0].to(dtype)).patches.shape == (0, 256, 10, 10)


def test_grids() -> None:
    image = torch.rand(1, 3, 420, 420)
    with torch.no_grad():
        assert DenseSift()(image).patches.shape == (1, 256, 30, 30)
        fine = DenseSift(supports=(28,), stride=7, offset=3.0)
        assert fine(image).patches.shape == (1, 128, 60, 60)
    assert fine.channels == 128
    assert DenseSift().channels == 256


@pytest.mark.parametrize("support", [28.0, 84.0])
def test_agrees_with_opencv(support: float) -> None:
    """cv2's SIFT at the same windows, upright.

    Not the same to the last digit by design: cv2 weights with a Gaussian of half the window's side (kornia: 0.7
    sides), interpolates between cells over a window that is a cell larger, and quantises. The mean cosine is 0.97;
    transposed cells or cells moved by one bring it below 0.6.
    """
    images = natural_images(3, 280)
    sigma = support / 12
    module = DenseSift(supports=(support,), contrast=0.0)
    found = module(images).patches.flatten(2).transpose(1, 2)
    found = convert_sift_descriptor_layout(found, "kornia", "opencv")
    centers = module.patch_grid(280).centers(images.device, images.dtype).flatten(0, 1).numpy()
    inside = ((centers > support) & (centers < 279 - support)).all(-1)
    sift = cv2.SIFT_create()
    keypoints = [cv2.KeyPoint(float(u), float(v), support / 6, 0.0, 1.0, 0) for u, v in centers[inside]]
    cosines, transposed, moved = [], [], []
    for image, ours in zip(rgb_to_grayscale(images), found[:, inside], strict=True):
        # cv2 blurs from 0.5 to 1.6 px for octave 0 itself
        blurred = ndimage.gaussian_filter(image[0].numpy(), (sigma**2 - 1.6**2 + 0.5**2) ** 0.5)
        gray = np.round(blurred / blurred.max() * 255).astype(np.uint8)
        _, theirs = sift.compute(gray, keypoints)
        theirs = torch.from_numpy(theirs / np.linalg.norm(theirs, axis=1, keepdims=True))
        cosines.append((ours * theirs).sum(-1))
        transposed.append((ours.reshape(-1, 4, 4, 8).transpose(1, 2).flatten(1) * theirs).sum(-1))
        moved.append((ours.reshape(-1, 128).roll(8, 1) * theirs).sum(-1))
    cosine = torch.cat(cosines)
    assert len(cosine) >= 100
    assert cosine.mean() > 0.95
    assert cosine.quantile(0.05) > 0.9
    assert torch.cat(transposed).mean() < 0.7
    assert torch.cat(moved).mean() < 0.7


def test_nearest_neighbours_agree_with_opencv() -> None:
    """Windows rank others by distance as cv2's descriptors do: Spearman's correlation of all distances."""
    image = natural_images(1, 280, seed=3)
    module = DenseSift(supports=(28.0,), contrast=0.0)
    found = module(image).patches[0].flatten(1).T
    centers = module.patch_grid(280).centers(image.device, image.dtype).flatten(0, 1).numpy()
    inside = ((centers > 28) & (centers < 251)).all(-1)
    gray = ndimage.gaussian_filter(rgb_to_grayscale(image)[0, 0].numpy(), ((28 / 12) ** 2 - 2.31) ** 0.5)
    keypoints = [cv2.KeyPoint(float(u), float(v), 28 / 6, 0.0, 1.0, 0) for u, v in centers[inside]]
    _, theirs = cv2.SIFT_create().compute(np.round(gray * 255).astype(np.uint8), keypoints)
    ours = torch.pdist(found[inside]).numpy()
    reference = torch.pdist(torch.from_numpy(theirs)).numpy()
    ranks = [np.argsort(np.argsort(d)) for d in (ours, reference)]
    assert np.corrcoef(*ranks)[0, 1] > 0.9


@pytest.mark.parametrize("sigma", [0.0, 2.5])
def test_windows_equal_scipy(sigma: float) -> None:
    image = natural_images(2, 70).double()[:, :1]
    centers = torch.tensor([[20.5, 30.0], [3.0, 66.0], [-4.0, 35.25]], dtype=torch.float64)
    windows = sample_windows(image, centers, support=21.0, size=9, sigma=sigma)
    assert windows.shape == (2, 3, 9, 9)
    offsets = (np.arange(9) + 0.5) / 9 * 21 - 10.5
    for b in range(2):
        reference = image[b, 0].numpy()
        if sigma:
            reference = ndimage.gaussian_filter(reference, sigma, mode="nearest", radius=8)
        for n, (u, v) in enumerate(centers.tolist()):
            at = np.stack(np.meshgrid(v + offsets, u + offsets, indexing="ij"))
            expected = ndimage.map_coordinates(reference, at, order=1, mode="nearest")
            np.testing.assert_allclose(windows[b, n].numpy(), expected, atol=1e-9)


def test_equals_kornias_descriptor_of_windows_cut_out() -> None:
    """With one sample per pixel and no blur the windows are plain slices."""
    image = natural_images(1, 70)
    out = DenseSift(supports=(16,), stride=14, offset=13.5, window_size=16, smoothing=0.0, contrast=0.0)(
        image
    )
    assert out.patches.shape == (1, 128, 4, 4)
    gray = rgb_to_grayscale(image)
    slices = gray.unfold(2, 16, 14).unfold(3, 16, 14)  # first window: pixels 0..15, centre 7.5
    sift = SIFTDescriptor(16, rootsift=False)
    expected = sift(gray[:, :, 6:22, 20:36])  # centre (27.5, 13.5) is row 0, column 1
    assert slices.shape[2] == 4
    torch.testing.assert_close(out.patches[:, :, 0, 1], expected, atol=1e-5, rtol=0)


def test_moving_the_image_by_a_stride_moves_the_grid() -> None:
    whole = natural_images(1, 420 + 28).double()
    module = DenseSift()
    a = module(whole[..., :420, :420]).patches
    b = module(whole[..., 14:434, 28:448]).patches
    # windows of 84 px and their blur (3 × 7 px) must lie inside both: 63 px, that is 5 cells
    torch.testing.assert_close(a[..., 6:25, 7:25], b[..., 5:24, 5:23], atol=1e-4, rtol=0)
    assert not torch.allclose(a[..., 6:25, 7:25], b[..., 6:25, 7:25], atol=0.1)


def test_sample_alone_equals_sample_in_batch() -> None:
    images = natural_images(3, 140)
    together = DenseSift()(images).patches
    for k in range(3):
        torch.testing.assert_close(DenseSift()(images[k : k + 1]).patches[0], together[k], atol=1e-6, rtol=0)


def test_brightness_and_contrast_change_nothing() -> None:
    images = natural_images(1, 140).double()
    module = DenseSift(contrast=0.0)
    expected = module(images).patches
    torch.testing.assert_close(module(0.5 * images).patches, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(module(0.5 * images + 0.3).patches, expected, atol=1e-4, rtol=0)
    # the contrast gate lets go of this only for windows of little contrast
    faded = DenseSift(contrast=0.01)
    textured = rgb_to_grayscale(images).unfold(2, 28, 14).unfold(3, 28, 14).std((-1, -2))[0, 0].min()
    gate = textured**2 / (textured**2 + 1e-4)
    a, b = faded(images).patches[..., 3:-3, 3:-3], faded(0.5 * images).patches[..., 3:-3, 3:-3]
    assert gate > 0.5
    assert torch.nn.functional.cosine_similarity(a[:, :128], b[:, :128], dim=1).min() > 0.999


def test_norms_are_one_per_support_and_fade_with_contrast() -> None:
    windows = natural_images(1, 64)[0, :1].unfold(1, 16, 16).unfold(2, 16, 16).reshape(-1, 16, 16).double()
    windows = windows - windows.mean((-1, -2), keepdim=True)
    windows = windows / windows.std((-1, -2), correction=0, keepdim=True) * 0.01
    sift = SIFTDescriptor(16, rootsift=False)
    torch.testing.assert_close(describe_windows(windows, sift, 0.0).norm(dim=1), torch.ones(16).double())
    half = describe_windows(windows, sift, 0.01)
    torch.testing.assert_close(half.norm(dim=1), torch.full((16,), 0.5, dtype=torch.float64))
    directions = torch.nn.functional.cosine_similarity(half, describe_windows(windows, sift, 0.0))
    torch.testing.assert_close(directions, torch.ones(16).double())


@pytest.mark.parametrize("rootsift", [False, True])
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_flat_images_give_zeros_and_finite_gradients(rootsift: bool, value: float) -> None:
    images = torch.full((1, 3, 84, 84), value, requires_grad=True)
    patches = DenseSift(rootsift=rootsift)(images).patches
    assert (patches.abs() < 1e-6).all()
    patches.square().sum().backward()
    assert torch.isfinite(images.grad).all()


@pytest.mark.parametrize("amplitude", [1e-8, 1e-6, 1e-4])
def test_gradients_are_bounded_on_nearly_black_images(amplitude: float) -> None:
    g = torch.Generator().manual_seed(0)
    images = (amplitude * torch.rand(1, 3, 84, 84, generator=g)).requires_grad_(True)
    DenseSift()(images).patches.sum().backward()
    assert torch.isfinite(images.grad).all()
    assert images.grad.abs().max() < 1e3


@pytest.mark.parametrize("rootsift", [False, True])
def test_image_gradient_equals_finite_differences(rootsift: bool) -> None:
    images = natural_images(1, 56).double()
    images[..., :20, :] = 0.0  # a black background, as templates have
    module = DenseSift(supports=(28, 42), rootsift=rootsift)
    g = torch.Generator().manual_seed(0)
    weights = torch.randn(1, 256, 4, 4, generator=g, dtype=torch.float64)
    direction = torch.from_numpy(ndimage.gaussian_filter(np.random.default_rng(0).random((3, 56, 56)), 1.0))

    def value(step: float) -> torch.Tensor:
        return (module(images + step * direction * (images > 0)).patches * weights).sum()

    x = images.clone().requires_grad_(True)
    (module(x).patches * weights).sum().backward()
    analytic = (x.grad * direction * (images > 0)).sum()
    numeric = (value(1e-7) - value(-1e-7)) / 2e-7
    torch.testing.assert_close(analytic, numeric, rtol=1e-3, atol=1e-5)
    assert analytic.abs() > 1e-2


def test_has_nothing_to_train_and_moves_between_dtypes() -> None:
    module = DenseSift()
    assert not [p for p in module.parameters() if p.requires_grad]
    images = natural_images(1, 84)
    expected = module(images).patches
    torch.testing.assert_close(module.double()(images).patches, expected, atol=1e-6, rtol=0)
    other = DenseSift()
    other.load_state_dict(DenseSift().state_dict())
    assert torch.equal(other(images).patches, expected)


def test_fingerprint_tells_settings_apart() -> None:
    variants = [
        {},
        {"supports": (42, 84)},
        {"stride": 7.0, "offset": 3.0},
        {"window_size": 20},
        {"smoothing": 0.05},
        {"contrast": 0.0},
        {"rootsift": not DenseSift().rootsift},
    ]
    prints = {str(sorted(DenseSift(**v).fingerprint().items())) for v in variants}
    assert len(prints) == len(variants)
    assert DenseSift().fingerprint() == DenseSift(supports=[28, 84], stride=14).fingerprint()


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.rand(3, 84, 84), r"\(B, 3, S, S\), got \(3, 84, 84\)"),
        (torch.rand(1, 3, 84, 70), r"got \(1, 3, 84, 70\)"),
        (torch.zeros(1, 3, 84, 84, dtype=torch.uint8), "uint8"),
        (torch.full((1, 3, 84, 84), 255.0), "divide"),
        (torch.rand(1, 3, 6, 6), "6 px have no patch; at least 14 px"),
    ],
)
def test_bad_images_are_refused(images: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DenseSift()(images)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"supports": ()}, "supports must be"),
        ({"supports": (28, -1)}, "supports must be"),
        ({"stride": 0}, "stride must be positive"),
        ({"offset": -1}, "offset not negative"),
        ({"window_size": 7}, "window_size must be at least 8"),
        ({"smoothing": -0.1}, "must not be negative"),
        ({"contrast": -0.1}, "must not be negative"),
    ],
)
def test_bad_settings_are_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DenseSift(**kwargs)

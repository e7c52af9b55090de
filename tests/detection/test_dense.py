import pytest
import torch
import torch.nn.functional as F

from foundpose.detection import DensePatches
from foundpose.features import DinoV2, PatchFeatures
from foundpose.geometry import masks_from_boxes
from tests.detection.conftest import Colors


def test_a_picture_of_one_tile_is_the_extractors(generator: torch.Generator) -> None:
    images = torch.rand(2, 3, 140, 140, generator=generator)
    (described,) = DensePatches(scales=[1.0], size=140, margin=0)(images, Colors())
    torch.testing.assert_close(described.descriptors, Colors()(images).patches)
    assert (described.stride, described.offset) == (14.0, 6.5)


@pytest.mark.parametrize("margin", [0, 1, 3])
@pytest.mark.parametrize("size", [(224, 308), (150, 430), (70, 90)])
def test_tiles_join_without_a_seam(margin: int, size: tuple[int, int], generator: torch.Generator) -> None:
    images = torch.rand(2, 3, *size, generator=generator)
    (described,) = DensePatches(scales=[1.0], size=140, margin=margin, batch_size=3)(images, Colors())
    torch.testing.assert_close(described.descriptors[:, :3], F.avg_pool2d(images, 14))


@pytest.mark.parametrize("scale", [2.0, 1.5])
def test_patches_lie_where_they_say(scale: float) -> None:
    u = torch.arange(200.0).expand(3, 120, 200) / 200
    (described,) = DensePatches(scales=[scale], size=140, margin=1)(u[None], Colors())
    columns = torch.arange(described.descriptors.shape[-1])
    expected = (described.stride * columns + described.offset) / 200
    inner = slice(1, -1)
    torch.testing.assert_close(described.descriptors[0, 0, 2, inner], expected[inner], atol=1e-5, rtol=0)


def test_several_scales_are_those_alone(generator: torch.Generator) -> None:
    images = torch.rand(2, 3, 100, 140, generator=generator)
    both = DensePatches(scales=[1.5, 1.0], size=140, margin=1)(images, Colors())
    for described, scale in zip(both, (1.5, 1.0), strict=True):
        (alone,) = DensePatches(scales=[scale], size=140, margin=1)(images, Colors())
        assert torch.equal(described.descriptors, alone.descriptors)
        assert described[1:] == alone[1:]


def test_masks_of_cells_and_back() -> None:
    (described,) = DensePatches(scales=[2.0], size=140, margin=1)(torch.zeros(1, 3, 120, 160), Colors())
    height, width = described.descriptors.shape[-2:]
    cells = torch.zeros(1, height, width, dtype=torch.bool)
    cells[0, 4:9, 3:12] = True
    mask = described.to_masks(cells, 120, 160)
    # Patch k covers pixels 7 k to 7 k + 6 of a picture that was enlarged twice.
    box = torch.tensor([[3 * 7 - 0.5, 4 * 7 - 0.5, 12 * 7 - 0.5, 9 * 7 - 0.5]])
    exact = masks_from_boxes(box, 120, 160)
    assert (mask & exact).sum() / (mask | exact).sum() > 0.95
    assert torch.equal(described.share_of(mask) > 0.5, cells)


def test_margin_hides_the_edges_of_tiles(generator: torch.Generator) -> None:
    class Edges(Colors):
        def forward(self, images: torch.Tensor) -> PatchFeatures:
            features = super().forward(images)
            marked = features.patches.clone()
            marked[..., 0, :] = marked[..., -1, :] = marked[..., :, 0] = marked[..., :, -1] = -1.0
            return PatchFeatures(marked, None)

    (described,) = DensePatches(scales=[1.0], size=140, margin=1)(torch.rand(1, 3, 224, 224), Edges())
    assert (described.descriptors >= 0).all()


def test_gradients_reach_the_picture() -> None:
    network = DinoV2(
        "vits14", layer=0, weights="random", seed=0, config={"hidden_size": 24, "num_attention_heads": 2}
    )
    images = torch.rand(1, 3, 60, 60, requires_grad=True)
    DensePatches(scales=[1.0], size=56, margin=0)(images, network)[0].descriptors.square().sum().backward()
    assert images.grad is not None
    assert (images.grad != 0).float().mean() > 0.5


def test_refusals() -> None:
    for scales in ([0.0], [], 2.0):
        with pytest.raises(
            ValueError, match=r"scales must be a list of positive numbers, such as \[2.0\], got"
        ):
            DensePatches(scales=scales)
    with pytest.raises(ValueError, match="margin"):
        DensePatches(margin=-1)
    with pytest.raises(ValueError, match="must leave some"):
        DensePatches(size=56, margin=2)(torch.zeros(1, 3, 60, 60), Colors())

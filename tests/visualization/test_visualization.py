import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from foundpose import PoseStatus
from foundpose.geometry import intrinsics_matrix
from foundpose.pipeline.figure import ObjectView
from foundpose.rendering import CoordinateRenderer
from foundpose.visualization import COARSE, TRUTH, draw_axes, draw_contour
from foundpose.visualization.tiles import principal_colors
from tests.pipeline.test_foundpose import SIZE, K, make_pipeline, pose_at


def test_contour_lies_around_the_mask(rng):
    mask = torch.zeros(40, 50, dtype=torch.bool)
    mask[10:20, 15:35] = True
    image = torch.from_numpy(rng.random((3, 40, 50)).astype(np.float32))
    drawn = draw_contour(image, mask, TRUTH, width=2)
    changed = (drawn != image).any(dim=0).numpy()
    expected = binary_dilation(mask.numpy(), np.ones((5, 5))) & ~mask.numpy()
    assert np.array_equal(changed, expected)
    assert torch.allclose(drawn[:, 9, 20], torch.tensor(TRUTH))


def test_axes_end_where_their_tips_project():
    T = torch.eye(4)
    T[2, 3] = 10.0
    camera = intrinsics_matrix(100.0, 100.0, 50.0, 40.0)
    image = torch.zeros(3, 80, 100)
    drawn = draw_axes(image, T, camera, length=2.0, width=1)
    assert drawn[0, 40, 60] > 0.9  # x axis, red, 20 px to the right
    assert drawn[0, 40, 72] == 0
    assert drawn[1, 50, 50] > 0.8  # y axis, green, 20 px down
    T[2, 3] = -10.0
    assert torch.equal(draw_axes(image, T, camera, length=2.0), image)


@pytest.fixture(scope="module")
def estimates(blob, oracle_blob):
    """A good estimate, and one of an empty mask."""
    T = pose_at(blob, (180.0, 150.0), 700.0, 1)
    render = CoordinateRenderer()(blob, T[None], K[None], SIZE)
    masks = torch.stack([render.mask[0], torch.zeros(SIZE, dtype=torch.bool)])
    with torch.no_grad():
        found = make_pipeline()(
            render.rgb, K[None], oracle_blob, masks=masks, image_index=torch.tensor([0, 0]), meshes=blob
        )
    return found, T


def count(picture, color):
    """Pixels of about a colour."""
    array, wanted = np.asarray(picture).astype(int), 255 * np.array(color)
    return int((((array - wanted) ** 2).sum(-1) < 900).sum())


@pytest.mark.parametrize("with_mesh", [True, False])
def test_figure_of_a_good_and_of_a_failed_estimate(estimates, with_mesh):
    e, T = estimates
    assert e.status.tolist() == [PoseStatus.OK, PoseStatus.UNUSABLE_MASK]
    if not with_mesh:
        e = e._replace(observation=e.observation._replace(meshes=None))
    good, failed = e.draw(0, T), e.draw(1, T, "an empty mask")
    # The coarse contour is blue and drawn on the good one only; the truth below it is red.
    assert count(good, COARSE) > 300
    assert count(failed, COARSE) < 100
    assert count(failed, TRUTH) > 100
    assert good.width == failed.width
    assert good.height < failed.height  # by the note


def test_outlines_of_points_are_those_of_the_mesh(estimates, blob, oracle_blob):
    T = estimates[1]
    mesh, points = (ObjectView(oracle_blob, m).outline(T, K, SIZE) for m in (blob, None))
    assert (mesh & points).sum() / (mesh | points).sum() > 0.95


def test_show_gives_a_figure_of_matplotlib(estimates):
    figure = estimates[0].show(0)
    width, height = figure.get_size_inches()
    assert width > height > 5
    assert len(figure.axes[0].images) == 1


def test_what_cannot_be_drawn_is_refused(estimates):
    with pytest.raises(ValueError, match="one of the 2 estimates, got 2"):
        estimates[0].draw(2)
    with pytest.raises(ValueError, match="lost the observation"):
        estimates[0]._replace(observation=None).draw(0)


def test_principal_colors_share_a_scale(rng):
    a = torch.from_numpy(rng.normal(size=(200, 8)).astype(np.float32))
    first, second = principal_colors(a, a[:50])
    assert torch.equal(first[:50], second)
    assert first.min() == 0
    assert first.max() == 1
    assert principal_colors(a[:0])[0].shape == (0, 3)
    assert principal_colors(a[:, :1])[0].shape == (200, 3)

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import binary_dilation

from foundpose import PoseStatus
from foundpose.geometry import intrinsics_matrix
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.visualization import TRUTH, ShownObject, draw_axes, draw_contour, save_estimate_figure
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


def test_figure_of_a_good_and_of_a_failed_estimate(blob, oracle_blob, tmp_path):
    T = pose_at(blob, (180.0, 150.0), 700.0, 1)
    render = CoordinateRenderer()(blob, T[None], K[None], SIZE)
    masks = torch.stack([render.mask[0], torch.zeros(SIZE, dtype=torch.bool)])
    with torch.no_grad():
        e = make_pipeline()(render.rgb, K[None], oracle_blob, masks=masks, image_index=torch.tensor([0, 0]))
    assert e.status.tolist() == [PoseStatus.OK, PoseStatus.UNUSABLE_MASK]
    for index in (0, 1):
        path = tmp_path / f"{index}.png"
        shown = ShownObject(blob, oracle_blob, RaycastRenderer())
        save_estimate_figure(path, render.rgb[0], K, e, index, shown, T)
        picture = np.asarray(Image.open(path).convert("RGB"))
        assert picture.shape[0] > 500
        assert picture.std() > 10
    # The coarse contour is blue and drawn on the good one only.
    blue = [
        (
            (np.asarray(Image.open(tmp_path / f"{i}.png").convert("RGB")).astype(int) - (51, 115, 255)) ** 2
        ).sum(-1)
        < 900
        for i in (0, 1)
    ]
    assert blue[0].sum() > 100 > blue[1].sum()

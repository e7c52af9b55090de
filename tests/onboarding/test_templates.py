import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from foundpose.geometry import PatchGrid, SuperFibonacci, project_points, transform_points
from foundpose.onboarding import TemplateCameras, register_patches, template_cameras
from foundpose.rendering import RaycastRenderer


@pytest.fixture(scope="module")
def views(blob):
    cameras = template_cameras(blob, SuperFibonacci(24)().float(), 420, 0.6, 6.0)
    renderer = RaycastRenderer(supersampling=1)
    return cameras, renderer(blob, *cameras, (420, 420)), renderer


def test_the_object_fills_the_share_of_the_template(views):
    cameras, render, _ = views
    for mask in render.mask:
        rows, columns = torch.nonzero(mask, as_tuple=True)
        height, width = (int(x.max() - x.min()) + 1 for x in (rows, columns))
        # The mesh's vertices reach 252 px; pixel centres see up to a pixel less.
        assert 250 <= max(height, width) <= 252
        for axis in (rows, columns):
            assert (axis.min() + axis.max()) / 2 == pytest.approx(209.5, abs=0.6)
    assert torch.allclose(cameras.K_template[:, :2, 2], torch.tensor(209.5))


def test_cameras_keep_their_distance_and_orientation(views, blob):
    cameras, _, _ = views
    centre = blob.bounds.mean(0)
    distance = transform_points(cameras.T_template_from_model, centre[None])[:, 0].norm(dim=1)
    assert torch.allclose(distance, torch.full_like(distance, 6 * blob.diameter), rtol=0.01)
    R = cameras.T_template_from_model[:, :3, :3]
    # Focusing the camera turns it by less than the angle that the object takes.
    turn = R @ SuperFibonacci(24)().float().transpose(1, 2)
    assert torch.rad2deg(torch.arccos(turn[:, 2, 2].clamp(max=1))).max() < 5


@pytest.mark.parametrize("erosion", [0, 5])
@pytest.mark.parametrize(("stride", "offset", "grid"), [(14.0, 6.5, 30), (7.0, 3.0, 60)])
def test_patches_are_registered_at_their_centres(views, blob, erosion, stride, offset, grid):
    cameras, render, renderer = views
    patches = register_patches(renderer, blob, cameras, render.mask, PatchGrid(stride, offset, grid), erosion)
    axis = torch.arange(grid) * stride + offset
    centres = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1)
    for b in range(len(render.mask)):
        valid = patches.valid[b]
        T = TemplateCameras(*(part[b] for part in cameras))
        points = transform_points(T.T_template_from_model, patches.points_model[b][valid])
        pixels, depth = project_points(points, T.K_template)
        assert (pixels - centres[valid]).abs().max() < 0.02
        mask = render.mask[b].numpy()
        if erosion:
            mask = binary_erosion(mask, np.ones((erosion, erosion)), border_value=1)
        low, high = np.floor(axis.numpy()).astype(int), np.ceil(axis.numpy()).astype(int)
        inside = (
            mask[np.ix_(low, low)]
            & mask[np.ix_(low, high)]
            & mask[np.ix_(high, low)]
            & mask[np.ix_(high, high)]
        )
        assert np.array_equal(valid.numpy(), inside)
        assert (patches.points_model[b][~valid] == 0).all()
        # The surface is where the full-size rendering has it, up to its slope over half a pixel.
        rendered = render.depth[b][pixels[:, 1].round().long(), pixels[:, 0].round().long()]
        assert (rendered - depth).abs().median() < 0.002 * blob.diameter

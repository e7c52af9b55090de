from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from benchmarking import ScriptedExtractor, WorkloadSizes, make_workload, subset, with_crops
from benchmarking.onboarding import projected_descriptors, raw_descriptors
from benchmarking.workload import SEMI_AXES, ellipsoid_mesh
from foundpose.geometry import PerspectiveCrop, project_points, rotation_angle, transform_points
from foundpose.pipeline import select_query_patches
from foundpose.retrieval import SoftAssignBow, TemplateRetriever

SIZES = WorkloadSizes(
    templates=100, patches=150, components=64, channels=96, words=200, crop_size=280, batch_size=4, images=2
)


@pytest.fixture(scope="module")
def workload():
    return make_workload(SIZES)


@pytest.mark.parametrize(("patches", "crop_size"), [(60, 280), (150, 280), (250, 280), (300, 420)])
def test_templates_and_crops_have_about_the_patches_asked_for(patches, crop_size):
    sizes = replace(SIZES, templates=50, patches=patches, crop_size=crop_size, outliers=0.0)
    workload = make_workload(sizes)
    counts = workload.representation.template_offsets.diff().float()
    assert counts.mean() == pytest.approx(patches, rel=0.1)
    assert counts.min() > 0.7 * patches
    crop = PerspectiveCrop(sizes.crop_size, sizes.fill)
    crops = crop(workload.images, workload.K, workload.masks, image_index=workload.image_index)
    in_crop = (crops.masks[:, 7::14, 7::14] > 0.5).flatten(1).sum(1).float()
    assert crops.valid.all()
    assert in_crop.mean() == pytest.approx(patches, rel=0.15)


def test_shapes(workload):
    representation = workload.representation
    assert representation.template_bow.shape == (100, 200)
    assert representation.words.shape == (200, 64)
    assert representation.projection.components.shape == (64, 96)
    assert workload.images.shape == (2, 3, 480, 640)
    assert workload.masks.shape == (4, 480, 640)
    assert workload.image_index.tolist() == [0, 0, 1, 1]
    assert workload.features.shape == (4, 96, 20, 20)


def test_same_sizes_same_workload(workload):
    again = make_workload(SIZES)
    for name, tensor in workload.representation.state_dict().items():
        assert torch.equal(tensor, again.representation.state_dict()[name]), name
    for name in ("images", "K", "masks", "T_camera_from_model", "features"):
        assert torch.equal(getattr(workload, name), getattr(again, name)), name
    other = make_workload(replace(SIZES, seed=1))
    assert not torch.equal(workload.features, other.features)
    assert not torch.equal(workload.T_camera_from_model, other.T_camera_from_model)


def test_patches_lie_on_the_ellipsoid_and_project_to_their_pixels(workload):
    representation = workload.representation
    patches = representation.gather_templates(torch.arange(5))
    on_surface = (patches.points_model / torch.tensor(SEMI_AXES)).square().sum(-1)[patches.valid]
    assert torch.allclose(on_surface, torch.ones_like(on_surface), atol=1e-4)
    seen = transform_points(representation.T_template_from_model[:5], patches.points_model)
    pixels, _ = project_points(seen, representation.K_template[:5])
    assert (pixels - patches.pixels)[patches.valid].abs().max() < 0.01


def test_masks_are_silhouettes_of_the_mesh_at_the_true_poses(workload):
    vertices = ellipsoid_mesh(5).vertices.expand(4, -1, -1)
    K = workload.K[workload.image_index]
    pixels, _ = project_points(transform_points(workload.T_camera_from_model, vertices), K)
    for mask, points in zip(workload.masks, pixels, strict=True):
        rows, columns = torch.nonzero(mask, as_tuple=True)
        box = torch.stack([columns.min(), rows.min(), columns.max(), rows.max()]).float()
        assert torch.allclose(box, torch.cat([points.amin(0), points.amax(0)]), atol=1.1)


@pytest.fixture(scope="module")
def clean():
    """Crops without outliers of an object with many templates, their patches and true poses in the crops."""
    workload = make_workload(replace(SIZES, templates=400, batch_size=8, images=1, outliers=0.0))
    crop = PerspectiveCrop(SIZES.crop_size, workload.sizes.fill)
    crops = crop(workload.images, workload.K, workload.masks, image_index=workload.image_index)
    extractor = ScriptedExtractor(workload.sizes, workload.features)
    query = select_query_patches(extractor(crops.images), crops, extractor)
    query = query._replace(descriptors=workload.representation.projection(query.descriptors))
    return workload.representation, crops, query, crops.T_crop_from_camera @ workload.T_camera_from_model


def test_matches_with_the_nearest_template_give_the_true_pose(clean):
    representation, crops, query, T_true = clean
    turn = rotation_angle(representation.T_template_from_model[None, :, :3, :3], T_true[:, None, :3, :3])
    patches = representation.gather_templates(turn.argmin(1))
    degrees, distances = [], []
    for i in range(len(T_true)):
        pixels = query.pixels[i, query.valid[i]]
        points = patches.points_model[i, patches.valid[i]]
        distance = torch.cdist(query.descriptors[i, query.valid[i]], patches.descriptors[i, patches.valid[i]])
        found, rotation, t, inliers = cv2.solvePnPRansac(
            points[distance.argmin(1)].double().numpy(),
            pixels.double().numpy(),
            crops.K_crop[i].double().numpy(),
            None,
            reprojectionError=10.0,
        )
        assert found
        assert len(inliers) > 0.6 * len(pixels)
        R = torch.from_numpy(cv2.Rodrigues(rotation)[0]).float()
        degrees.append(float(torch.rad2deg(rotation_angle(R, T_true[i, :3, :3]))))
        distances.append(np.linalg.norm(t[:, 0] - T_true[i, :3, 3].numpy()) / np.linalg.norm(t))
    # A template up to 20 degrees away does not show all that the crop shows.
    assert np.median(degrees) < 4.0
    assert max(degrees) < 15.0
    assert max(distances) < 0.05


def test_retrieved_templates_show_the_side_that_the_crop_shows(clean):
    """In-plane turns look alike to a bag of words, so the viewing direction is what it can tell."""
    representation, _, query, T_true = clean
    found = TemplateRetriever(SoftAssignBow(), 1)(query, representation).index[:, 0]
    cosine = (representation.T_template_from_model[found, 2, :3] * T_true[:, 2, :3]).sum(1)
    assert torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max() < 30  # of random ones, 7 %


def test_other_crops_of_the_same_object(workload):
    more = with_crops(workload, 6, images=3)
    assert more.representation is workload.representation
    assert more.features.shape[0] == 6
    assert more.sizes == replace(SIZES, batch_size=6, images=3)
    fresh = make_workload(more.sizes)
    assert torch.equal(more.features, fresh.features)
    assert torch.equal(more.masks, fresh.masks)


def test_double_precision():
    workload = make_workload(replace(SIZES, templates=20, words=50)).to(torch.float64)
    assert workload.representation.descriptors.dtype == torch.float64
    assert workload.representation.patch_index.dtype == torch.int16
    more = with_crops(workload, 2)
    assert more.features.dtype == torch.float64
    assert more.representation.projection.components.dtype == torch.float64


def test_subset(workload):
    part = subset(workload.representation, 30)
    assert part.num_templates == 30
    index = torch.tensor([3, 29])
    whole = workload.representation.gather_templates(index)
    few = part.gather_templates(index)
    most = part.max_patches
    assert torch.equal(few.descriptors, whole.descriptors[:, :most])
    assert torch.equal(few.pixels[few.valid], whole.pixels[:, :most][few.valid])


def test_raw_descriptors_project_to_codes_with_noise(workload):
    raw = raw_descriptors(workload)
    representation = workload.representation
    assert raw.shape == (len(representation.descriptors), 96)
    noise = representation.projection(raw) - representation.descriptors
    ratio = noise.square().sum(1).mean() / representation.descriptors.square().sum(1).mean()
    assert ratio.sqrt() == pytest.approx(0.5, rel=0.01)
    power = noise.square().mean(0)
    assert power[0] > 20 * power[-1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"templates": 0}, "templates must be at least 1, got 0"),
        ({"crop_size": 425}, "crop_size must be a multiple of 14 px"),
        ({"crop_size": 140}, "patches must be at most 70 of the 10² of a crop of 140 px, got 150"),
        ({"components": 97}, r"components \(97\) must not exceed channels \(96\)"),
        ({"words": 10**6}, "words must be at most half of templates"),
        ({"images": 5}, r"images \(5\) must not exceed batch_size \(4\)"),
        ({"outliers": 1.0}, r"outliers must lie in \[0, 1\), got 1.0"),
    ],
)
def test_bad_sizes(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(SIZES, **changes)


@pytest.mark.gpu
def test_same_workload_on_a_gpu(workload):
    other = make_workload(SIZES, "cuda")
    assert torch.allclose(workload.features, other.features.cpu(), atol=1e-3)
    assert torch.equal(workload.representation.template_offsets, other.representation.template_offsets.cpu())


def test_descriptors_for_clustering_leave_double_precision_alone() -> None:
    workload = make_workload(SIZES).to(torch.float64)
    before = workload.representation.projection.components.clone()
    descriptors = projected_descriptors(workload)
    assert descriptors.dtype == torch.float32
    after = workload.representation.projection.components
    assert after.dtype == torch.float64
    assert torch.equal(before, after)

"""Everything but the backbone on real geometry: true coordinates as descriptors, LM-O's poses and occlusion."""

import numpy as np
import pytest
import torch

from foundpose.bop import BopDataset, ground_truth_instances
from foundpose.bop.pictures import TrueCoordinates
from foundpose.features import CoordinateCode, PatchNoise
from foundpose.geometry import SuperFibonacci, project_to_rotation, rotation_angle
from foundpose.onboarding import Onboarder
from foundpose.optimization import BarronLoss
from foundpose.refinement import FeaturemetricAlignment, FeaturemetricRefiner
from foundpose.rendering import CoordinateRenderer, load_mesh
from foundpose.retrieval import SoftAssignBow, VisualWords
from tests.pipeline.test_foundpose import make_pipeline
from tests.pose_errors import average_recalls, max_symmetric_errors

OBJECT = 5
NUM_IMAGES = 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "refine", "least_mspd", "least_mssd", "most_degrees"),
    [(0.0, False, 0.97, 0.85, 1.5), (0.3, False, 0.95, 0.8, 2.5), (0.0, True, 0.99, 0.95, 0.35)],
)
def test_true_coordinates_on_real_poses(
    lmo_root, representation, noise, refine, least_mspd, least_mssd, most_degrees
):
    dataset = BopDataset(lmo_root)
    pictures = TrueCoordinates()
    alignment = FeaturemetricAlignment(BarronLoss(-5.0, 0.5), residual="norm")
    refiner = FeaturemetricRefiner(alignment) if refine else None
    pipeline = make_pipeline(PatchNoise(CoordinateCode(), noise), refiner=refiner)
    vertices = load_mesh(lmo_root / "models_eval" / f"obj_{OBJECT:06d}.ply").vertices.double().numpy()
    instances = [i for i in ground_truth_instances(dataset) if i.obj_id == OBJECT]
    errors, angles = [], []
    for instance in instances[:: len(instances) // NUM_IMAGES][:NUM_IMAGES]:
        annotation = dataset.annotations(instance.scene_id, instance.im_id)[instance.annotation_index]
        assert annotation.visible_fraction > 0.1
        K = dataset.intrinsics(instance.scene_id, instance.im_id)
        image = pictures(dataset, instance.scene_id, instance.im_id)
        with torch.no_grad():
            e = pipeline(image[None], K.float()[None], representation, masks=instance.mask(dataset)[None])
        assert e.valid[0]
        T, T_true = e.T_camera_from_model[0].double(), annotation.T_camera_from_model
        errors.append(max_symmetric_errors(T.numpy(), T_true.numpy(), vertices, K.numpy(), [np.eye(4)]))
        angles.append(torch.rad2deg(rotation_angle(T[:3, :3], project_to_rotation(T_true[:3, :3]))).item())
    mssd, mspd = average_recalls(errors, [dataset.diameter(OBJECT)] * len(errors))
    assert len(errors) == NUM_IMAGES
    assert mspd >= least_mspd
    assert mssd >= least_mssd
    assert np.median(angles) < most_degrees


@pytest.fixture(scope="module")
def representation(lmo_root):
    """Object 5 with 200 templates and 512 words."""
    onboarder = Onboarder(
        CoordinateRenderer(), CoordinateCode(), SuperFibonacci(200), VisualWords(512), SoftAssignBow()
    )
    return onboarder(load_mesh(BopDataset(lmo_root).mesh_path(OBJECT)), "obj_5")

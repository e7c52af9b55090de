import pytest
import torch
from torch import nn

from foundpose import FoundPose, MatchAndSolve
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, intrinsics_matrix, make_transform, rotation_angle
from foundpose.matching import PatchMatcher
from foundpose.pnp import RansacPnp
from foundpose.refinement import FeaturemetricAlignment, FeaturemetricRefiner, RefinerChain
from foundpose.rendering import CoordinateRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import SoftAssignBow, TemplateRetriever
from tests.refinement.learned import Oracle


@pytest.mark.parametrize("refine_what", ["best", "all"])
def test_chain_in_the_pipeline(blob, oracle_blob, refine_what):
    t = torch.tensor([[30.0, -20.0, 700.0], [-120.0, 60.0, 900.0]])
    T = make_transform(torch.eye(3).expand(2, 3, 3), t)
    K_large = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)
    renderer = CoordinateRenderer()
    image = render_coordinate_image(renderer, [blob, blob], list(T), K_large, (480, 640))
    masks = renderer(blob, T, K_large.expand(2, 3, 3), (480, 640)).mask

    def estimate(refiner, **arguments):
        pipeline = FoundPose(
            PerspectiveCrop(),
            CoordinateCode(),
            TemplateRetriever(SoftAssignBow(), num_templates=2),
            MatchAndSolve(PatchMatcher(), RansacPnp()),
            refiner,
            refine_what,
        ).eval()
        with torch.no_grad():
            return pipeline(
                image[None],
                K_large[None],
                oracle_blob,
                masks=masks,
                image_index=torch.tensor([0, 0]),
                **arguments,
            )

    def learned():
        return Oracle(nn.Identity(), renderer, iterations=1, size=32)

    featuremetric = FeaturemetricRefiner(FeaturemetricAlignment(max_iterations=5))
    n = 2 if refine_what == "best" else 4
    last = learned().aim(T.repeat_interleave(n // 2, 0))
    found = estimate(RefinerChain([featuremetric, last]), meshes=blob)
    assert found.valid.all()
    angle = rotation_angle(found.T_camera_from_model[:, :3, :3], T[:, :3, :3])
    assert torch.rad2deg(angle).max() < 0.1
    torch.testing.assert_close(found.T_camera_from_model[:, :3, 3], T[:, :3, 3], rtol=1e-3, atol=0.1)
    coarse = rotation_angle(found.T_coarse[:, :3, :3], T[:, :3, :3])
    assert (angle < coarse).all()
    # The scores are the featuremetric ones: this network gives none.
    torch.testing.assert_close(found.score, estimate(featuremetric).score)
    with pytest.raises(ValueError, match=r"pass their meshes to FoundPose\.forward"):
        estimate(last)

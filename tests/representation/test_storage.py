"""Descriptors in half precision."""

import pytest
import torch

from foundpose.features import CoordinateCode, PcaProjection
from foundpose.geometry import intrinsics_matrix, rotation_angle
from foundpose.optimization import BarronLoss
from foundpose.refinement import FeaturemetricAlignment, FeaturemetricRefiner
from foundpose.rendering import CoordinateRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.representation import ObjectRepresentation
from tests.onboarding.test_onboarder import make_onboarder
from tests.pipeline.test_foundpose import make_pipeline, pose_at

SIZE = (480, 640)
K = intrinsics_matrix(600.0, 605.0, 322.0, 236.0)


@pytest.fixture(scope="module")
def half(oracle_blob):
    """As `oracle_blob`, with descriptors in float16; test_quantization.py: onboarding gives the same."""
    return oracle_blob.with_storage("float16")


def test_half_precision_halves_the_descriptors_and_nothing_else(oracle_blob, half, tmp_path):
    assert half.info.settings["storage"] == "float16"
    assert half.descriptors.dtype == torch.float16
    full, less = oracle_blob.memory_bytes(), half.memory_bytes()
    assert less.pop("descriptors") * 2 == full.pop("descriptors")
    assert full.pop("total") - less.pop("total") == half.descriptors.numel() * 2
    assert full == less
    assert {"words", "idf", "template_bow", "points_model", "projection", "patch_index"} < set(full)
    # Everything else is made of the descriptors in full.
    for name, tensor in oracle_blob.state_dict().items():
        if name != "descriptors":
            assert torch.equal(tensor, half.state_dict()[name]), name
    assert torch.equal(half.descriptors, oracle_blob.descriptors.half())
    half.save(tmp_path / "half.safetensors")
    oracle_blob.save(tmp_path / "full.safetensors")
    sizes = [(tmp_path / name).stat().st_size for name in ("full.safetensors", "half.safetensors")]
    assert sizes[0] - sizes[1] == pytest.approx(half.descriptors.numel() * 2, abs=100)
    again = ObjectRepresentation.load(tmp_path / "half.safetensors")
    assert torch.equal(again.descriptors, half.descriptors)
    assert again.descriptors.dtype == torch.float16


def test_gathered_descriptors_are_float32(oracle_blob, half):
    index = torch.tensor([[3, 0], [99, 3]])
    full, less = oracle_blob.gather_templates(index), half.gather_templates(index)
    assert less.descriptors.dtype == torch.float32
    scale = full.descriptors.norm(dim=-1).amax()
    assert 0 < (full.descriptors - less.descriptors).norm(dim=-1).amax() < 1e-3 * scale
    assert torch.equal(full.points_model, less.points_model)
    # A representation that is half precision as a whole stays that.
    assert (
        oracle_blob.__class__(
            **{
                name: tensor.half() if tensor.is_floating_point() else tensor
                for name, tensor in oracle_blob.state_dict().items()
                if not name.startswith("projection")
            },
            projection=PcaProjection.from_covariance(torch.zeros(64), torch.eye(64), 8).half(),
            template_cls=None,
            info=oracle_blob.info,
        )
        .gather_templates(index)
        .descriptors.dtype
        == torch.float16
    )


@pytest.mark.parametrize("refined", [False, True])
def test_poses_barely_move(oracle_blob, half, blob, refined):
    T_true = torch.stack([pose_at(blob, (100.0 + 60 * i, 140.0 + 25 * i), 800.0, i) for i in range(8)])
    renderer = CoordinateRenderer()
    images = torch.stack([render_coordinate_image(renderer, [blob], [T], K, SIZE) for T in T_true])
    masks = renderer(blob, T_true, K.expand(8, 3, 3), SIZE).mask
    alignment = FeaturemetricAlignment(BarronLoss(-5.0, 0.5), residual="norm")
    pipeline = make_pipeline(refiner=FeaturemetricRefiner(alignment) if refined else None)
    with torch.no_grad():
        full, less = (pipeline(images, K.expand(8, 3, 3), r, masks=masks) for r in (oracle_blob, half))
    assert torch.equal(full.templates.index, less.templates.index)
    assert full.valid.all()
    assert less.valid.all()
    same = full.correspondences.points_model == less.correspondences.points_model
    assert same.all(-1)[full.correspondences.valid].float().mean() > 0.99
    angle = torch.rad2deg(rotation_angle(*(e.T_camera_from_model[:, :3, :3].double() for e in (full, less))))
    moved = (full.T_camera_from_model - less.T_camera_from_model)[:, :3, 3].norm(dim=1) / blob.diameter
    assert angle.median() < 0.05
    assert angle.max() < 0.5
    assert moved.max() < 0.02
    error = [
        torch.rad2deg(rotation_angle(e.T_camera_from_model[:, :3, :3], T_true[:, :3, :3])).mean()
        for e in (full, less)
    ]
    assert abs(error[0] - error[1]) < 0.1


def test_bad_storage(blob):
    with pytest.raises(
        ValueError, match=r"storage must be one of \('float32', 'float16', 'int8', 'pq'\), got 'int4'"
    ):
        make_onboarder(storage="int4")
    loud = make_onboarder(extractor=CoordinateCode(norm=1e6), storage="float16")
    with pytest.raises(ValueError, match="do not fit float16; use storage=float32"):
        loud(blob, "blob")

import copy
import math
from dataclasses import replace

import pytest
import torch

from foundpose import RaycastRenderer, SoftAssignBow
from foundpose.features import DenseSift, PcaProjection
from foundpose.geometry import SuperFibonacci
from foundpose.onboarding import Onboarder
from foundpose.onboarding.scales import measure_scales, true_matches
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import VisualWords
from foundpose.synthetic import procedural_mesh

NOISE, D = 0.3, 64


def noisy(representation: ObjectRepresentation, amount: float) -> ObjectRepresentation:
    """A copy of the object with descriptors that are a smooth code of the point, and noise of a known size."""
    representation = copy.deepcopy(representation)
    g = torch.Generator().manual_seed(0)
    points = representation.points_model / representation.info.diameter
    waves = torch.randn(3, D, generator=g)
    code = 5.0 * torch.cos(points @ waves + 6.28 * torch.rand(D, generator=g))
    representation.descriptors = code + amount * torch.randn(code.shape, generator=g)
    return representation


@pytest.fixture(scope="module")
def dense_blob(oracle_onboarder, blob) -> ObjectRepresentation:
    dense = Onboarder(
        oracle_onboarder.renderer,
        oracle_onboarder.extractor,
        SuperFibonacci(200),
        VisualWords(64, 3),
        SoftAssignBow(),
        PcaProjection(D),
        image_size=280,
    )
    return dense(blob, "blob")


def test_true_matches_see_the_same_point(dense_blob):
    pairs = true_matches(dense_blob)
    assert len(pairs.first) > 200
    points = dense_blob.points_model
    away = torch.linalg.vector_norm(points[pairs.first] - points[pairs.second], dim=1)
    # A patch of this object is about a tenth of its diameter wide.
    assert away.max() < 0.03 * dense_blob.info.diameter
    of = torch.bucketize(pairs.first, dense_blob.template_offsets, right=True)
    assert (of != torch.bucketize(pairs.second, dense_blob.template_offsets, right=True)).all()


def test_scales_of_a_case_with_a_known_answer(dense_blob):
    clean = measure_scales(noisy(dense_blob, 0.0))
    scales = measure_scales(noisy(dense_blob, NOISE * 5.0))
    sigma = math.sqrt(2.0) * NOISE * 5.0  # of the difference of two patches
    # What the code itself changes between neighbouring points comes on top.
    assert clean.channel < 0.15 * sigma
    assert scales.channel == pytest.approx(sigma, rel=0.05)
    assert scales.match == pytest.approx(sigma * math.sqrt(D), rel=0.05)
    doubled = noisy(dense_blob, NOISE * 5.0)
    doubled.descriptors = 2.0 * doubled.descriptors
    doubled.words = 2.0 * doubled.words
    twice = measure_scales(doubled)
    assert twice.match == pytest.approx(2.0 * scales.match, rel=1e-5)
    assert twice.unit == pytest.approx(scales.unit, rel=1e-4)


def test_onboarding_stores_them(tmp_path):
    onboarder = Onboarder(
        RaycastRenderer(1),
        DenseSift(),
        SuperFibonacci(60),
        VisualWords(64, 3),
        SoftAssignBow("auto"),
        PcaProjection(32),
        image_size=224,
    )
    made = onboarder(procedural_mesh(1, subdivisions=4), "thing")
    assert set(made.info.scales) == {"word", "match", "channel", "unit"}
    made.save(tmp_path / "thing.safetensors")
    loaded = ObjectRepresentation.load(tmp_path / "thing.safetensors")
    assert loaded.info.scales == made.info.scales
    # The automatic σ is the measured one.
    onboarder.bow.sigma = 0.4 * made.info.scales["word"]
    torch.testing.assert_close(
        onboarder(procedural_mesh(1, subdivisions=4), "x").template_bow, made.template_bow
    )


def test_what_was_not_measured_is_named(oracle_blob):
    info = replace(oracle_blob.info, scales={})
    with pytest.raises(
        ValueError, match="sigma is auto, but the representation of 'blob' has no measured scale"
    ):
        info.scale("word", "sigma")

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from foundpose.features import CoordinateCode, DenseSift, PcaProjection
from foundpose.geometry import SphereInplane, SuperFibonacci, project_points, transform_points
from foundpose.onboarding import Onboarder, RepresentationStore
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SoftAssignBow, VisualWords


def make_onboarder(**changes):
    settings = {
        "renderer": CoordinateRenderer(),
        "extractor": CoordinateCode(),
        "viewpoints": SuperFibonacci(12),
        "words": VisualWords(64),
        "bow": SoftAssignBow(),
        "projection": PcaProjection(32),
    }
    return Onboarder(**(settings | changes))


@pytest.fixture(scope="module")
def small(blob):
    return make_onboarder()(blob, "blob")


def test_points_lie_on_the_patches_and_descriptors_belong_to_them(oracle_blob, blob):
    r, code = oracle_blob, CoordinateCode()
    for t in (0, 70, 99):
        patches = r.gather_templates(torch.tensor([t]))
        valid = patches.valid[0]
        assert valid.sum() > 100
        points = patches.points_model[0][valid]
        pixels, _ = project_points(transform_points(r.T_template_from_model[t], points), r.K_template[t])
        assert (pixels - patches.pixels[0][valid]).abs().max() < 0.05
        # The oracle's descriptor is a known function of the point.
        coordinates = (points - blob.bounds.mean(0)) / blob.diameter
        raw = torch.cos(coordinates @ code.directions + code.phases) * 40 * (2 / 256) ** 0.5
        error = (r.projection(raw) - patches.descriptors[0][valid]).norm(dim=1)
        assert error.median() < 0.5


def test_projection_and_bags_of_words_equal_references(small, blob):
    # All raw descriptors again, through scikit-learn.
    r, extractor = small, CoordinateCode()
    render = CoordinateRenderer()(blob, r.T_template_from_model, r.K_template, (420, 420))
    raw = extractor(render.rgb).patches.flatten(2).transpose(1, 2)
    rows = torch.repeat_interleave(torch.arange(12), r.template_offsets.diff())
    raw = raw[rows, r.patch_index.long()]
    reference = PCA(32, svd_solver="full").fit(raw.double().numpy())
    assert np.allclose(reference.explained_variance_, r.projection.explained_variance.numpy(), rtol=1e-4)
    ours = r.descriptors.double().numpy()
    theirs = reference.transform(raw.double().numpy())
    assert np.abs(np.abs(ours) - np.abs(theirs)).max() < 1e-2 * np.abs(theirs).max()

    # tf-idf with soft assignment, patch by patch in NumPy.
    words = r.words.double().numpy()
    counts = np.zeros((12, 64))
    occurs = np.zeros((12, 64), dtype=bool)
    for row, descriptor in zip(rows.tolist(), ours, strict=True):
        d2 = ((words - descriptor) ** 2).sum(1)
        nearest = np.argsort(d2)[:3]
        weight = np.exp(-(d2[nearest] - d2[nearest].min()) / (2 * 10.0**2))
        counts[row, nearest] += weight / weight.sum()
        occurs[row, nearest] = True
    idf = np.log(12 / np.maximum(occurs.sum(0), 1)) * (occurs.sum(0) > 0)
    bow = counts / counts.sum(1, keepdims=True) * idf
    bow = np.sqrt(bow)  # Hellinger
    bow /= np.linalg.norm(bow, axis=1, keepdims=True)
    assert np.allclose(r.idf.numpy(), idf, atol=1e-5)
    assert np.allclose(r.template_bow.numpy(), bow, atol=1e-4)


def test_deterministic_and_independent_of_the_batch_size(small, blob):
    again = make_onboarder(batch_size=5)(blob, "blob")
    for name, tensor in small.state_dict().items():
        assert torch.allclose(tensor.float(), again.state_dict()[name].float(), atol=1e-3), name


def test_progress_tells_every_stage(blob):
    calls = []
    make_onboarder()(blob, "blob", lambda *call: calls.append(call))
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert stages == ["templates", "PCA", "visual words", "bags of words"]
    assert ("templates", 12, 12) in calls
    for stage in stages:
        done = [call[1] for call in calls if call[0] == stage]
        assert done == sorted(done)
        assert done[-1] == next(call[2] for call in calls if call[0] == stage)


def test_other_viewpoints_and_extractor(blob):
    onboarder = make_onboarder(
        renderer=RaycastRenderer(),
        extractor=DenseSift(),
        viewpoints=SphereInplane(3, 2),
        bow=SoftAssignBow(0.3),
    )
    r = onboarder(blob, "blob")
    assert r.num_templates == 6
    assert r.info.extractor == DenseSift().fingerprint()
    assert torch.isfinite(r.descriptors).all()


def test_bad_settings(blob):
    for change, message in (
        ({"mask_erosion": 4}, "mask_erosion must be 0 or odd, got 4"),
        ({"distance": 0.5}, "more than one diameter, got 0.5"),
        ({"idf_mode": "log"}, "idf_mode must be one of .*, got 'log'"),
        ({"fill": 1.2}, r"fill must be in \(0, 1\], got 1.2"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make_onboarder(**change)
    with pytest.raises(
        ValueError, match="num_components is 300 but the extractor's descriptors have 256 channels"
    ):
        make_onboarder(projection=PcaProjection(300))
    with pytest.raises(ValueError, match="cannot make 64 clusters of"):
        make_onboarder(
            viewpoints=SuperFibonacci(1), extractor=CoordinateCode(stride=70.0), projection=PcaProjection(2)
        )(blob, "blob")


def test_store_onboards_once_and_separates_settings(blob, tmp_path):
    store = RepresentationStore(tmp_path, make_onboarder())
    assert not store.has(blob, "blob")
    calls = []
    first = store.get(blob, "blob", lambda *call: calls.append(call))
    assert store.has(blob, "blob")
    assert calls
    calls.clear()
    second = store.get(blob, "blob", lambda *call: calls.append(call))
    assert not calls
    assert torch.equal(first.descriptors, second.descriptors)
    other = RepresentationStore(tmp_path, make_onboarder(projection=PcaProjection(16)))
    assert not other.has(blob, "blob")
    assert other.path(blob, "blob") != store.path(blob, "blob")
    assert isinstance(ObjectRepresentation.load(store.path(blob, "blob")), ObjectRepresentation)


class TwoSides(torch.nn.Module):
    """Viewpoints of somebody's own, which do not say their settings."""

    def forward(self):
        return torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)


def test_viewpoints_must_say_their_settings():
    with pytest.raises(ValueError, match=r"TwoSides has no method settings\(\), so files made with it"):
        make_onboarder(viewpoints=TwoSides())
    viewpoints = TwoSides()
    viewpoints.settings = lambda: {"sides": 2}
    assert make_onboarder(viewpoints=viewpoints).settings()["viewpoints"] == "TwoSides(sides=2)"

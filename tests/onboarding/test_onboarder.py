import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from foundpose.features import AdaptedExtractor, CoordinateCode, DenseSift, DinoV2, PcaProjection
from foundpose.geometry import SphereInplane, SuperFibonacci, project_points, transform_points
from foundpose.onboarding import ArtefactStore, CachedOnboarding, Onboarder, RepresentationStore
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
        ({"margin": -1}, "margin must be at least 0, or null for whole pictures, got -1"),
        ({"margin": 1}, "margin is 1 but CoordinateCode describes pictures as a whole only"),
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


def test_templates_without_what_lies_far_from_the_object(blob, tmp_path):
    sizes = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "image_size": 70}
    extractor = DinoV2("vits14", 1, seed=0, config=sizes, weights="random")
    settings = {
        "renderer": RaycastRenderer(),
        "extractor": AdaptedExtractor(extractor),
        "image_size": 140,
        "viewpoints": SuperFibonacci(12),
    }
    whole = make_onboarder(**settings)
    cut = make_onboarder(**settings, margin=1)
    # 28 px, two patches, lie beside the object; of ten one is left out along each edge
    assert (whole.border, cut.border) == (0, 1)
    assert make_onboarder(**settings, margin=0).border == 2
    made, of_whole = cut(blob, "blob"), whole(blob, "blob")
    assert torch.equal(made.patch_index, of_whole.patch_index)
    assert not torch.equal(made.template_cls, of_whole.template_cls)
    render = RaycastRenderer()(blob, made.T_template_from_model, made.K_template, (140, 140))
    with torch.no_grad():
        images = (render.rgb * 255).round() / 255
        features = extractor(images, 1)
    rows = torch.repeat_interleave(torch.arange(12), made.template_offsets.diff())
    raw = features.patches.flatten(2).mT[rows, made.patch_index.long()]
    assert raw.any(1).all()  # none of the object's patches is left out
    assert torch.allclose(made.projection(raw), made.descriptors, atol=1e-4)
    # Neither representation nor artefacts are confused with those of whole templates.
    assert (made.info.settings["border"], of_whole.info.settings.get("border")) == (1, None)
    assert whole.settings() == make_onboarder(**settings, margin=2).settings()
    store = ArtefactStore(tmp_path)
    cached = CachedOnboarding(cut, store)
    assert torch.equal(cached(blob, "blob").descriptors, made.descriptors)
    facts = (CachedOnboarding(whole, store).facts(blob), cached.facts(blob))
    assert [kind for kind in facts[0] if facts[0][kind] != facts[1][kind]] == ["descriptors", "words"]

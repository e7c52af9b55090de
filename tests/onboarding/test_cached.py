import os
import signal
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from foundpose.config import build_method
from foundpose.features import CoordinateCode, DenseSift, DinoV2, PcaProjection
from foundpose.geometry import SphereInplane, SuperFibonacci
from foundpose.onboarding import ArtefactStore, CachedOnboarding, RepresentationStore
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SoftAssignBow, VisualWords
from foundpose.synthetic import procedural_mesh
from tests.onboarding.jobs import SIZE, die_while_writing_descriptors, onboard, small_onboarder
from tests.processes import CONTEXT

KINDS = ["descriptors", "patches", "renderings", "words"]
EVERYTHING = {"renderings", "patches", "descriptors", "PCA", "words"}
FITTED = {"PCA", "words"}


class Work:
    """Counts what an onboarder does: templates rendered and described, PCA fits and clusterings."""

    def __init__(self, onboarder, monkeypatch):
        self.done = {}
        onboarder.renderer.register_forward_pre_hook(self._rendered)
        onboarder.extractor.register_forward_pre_hook(
            lambda _, arguments: self._add("descriptors", len(arguments[0]))
        )
        onboarder.words.register_forward_pre_hook(lambda *_: self._add("words", 1))
        fit = PcaProjection.fit

        def counted(projection, accumulator):
            self._add("PCA", 1)
            return fit(projection, accumulator)

        monkeypatch.setattr(PcaProjection, "fit", counted)
        self.image_size = onboarder.image_size

    def _rendered(self, _, arguments):
        whole = arguments[3] == (self.image_size, self.image_size)
        self._add("renderings" if whole else "patches", len(arguments[1]))

    def _add(self, what, count):
        self.done[what] = self.done.get(what, 0) + count


def assert_same(a: ObjectRepresentation, b: ObjectRepresentation):
    first, second = a.state_dict(), b.state_dict()
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert tensor.dtype == second[name].dtype, name
        assert torch.equal(tensor, second[name]), name
    assert a.info == b.info


@pytest.fixture(scope="module")
def filled(blob, tmp_path_factory):
    """Artefacts of the blob under the settings of `small_onboarder`."""
    artefacts = ArtefactStore(tmp_path_factory.mktemp("artefacts"))
    CachedOnboarding(small_onboarder(), artefacts)(blob, "blob")
    assert list(artefacts.size()) == [*KINDS, "total"]
    return artefacts


@pytest.mark.parametrize(
    ("change", "redone"),
    [
        ({}, set()),
        ({"bow": SoftAssignBow(2.0)}, set()),
        ({"bow": SoftAssignBow(num_nearest=1)}, set()),
        ({"idf_mode": "occurrence"}, set()),
        ({"storage": "float16"}, set()),
        ({"batch_size": 3}, set()),
        ({"words": VisualWords(30)}, FITTED),
        ({"words": VisualWords(40, seed=1)}, FITTED),
        ({"projection": PcaProjection(8)}, FITTED),
        ({"extractor": CoordinateCode(wavelength=0.7)}, FITTED | {"descriptors"}),
        ({"extractor": DenseSift()}, FITTED | {"descriptors"}),
        ({"mask_erosion": 3}, FITTED | {"descriptors", "patches"}),
        ({"extractor": CoordinateCode(stride=7.0, offset=3.0)}, FITTED | {"descriptors", "patches"}),
        ({"extractor": CoordinateCode(offset=8.0)}, FITTED | {"descriptors", "patches"}),
        ({"viewpoints": SuperFibonacci(11)}, EVERYTHING),
        ({"viewpoints": SphereInplane(5, 2)}, EVERYTHING),
        ({"renderer": RaycastRenderer()}, EVERYTHING),
        ({"renderer": RaycastRenderer(supersampling=1)}, EVERYTHING),
        ({"fill": 0.7}, EVERYTHING),
        ({"distance": 5.0}, EVERYTHING),
        ({"image_size": 224}, EVERYTHING),
    ],
    ids=lambda value: " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else "",
)
def test_a_change_redoes_only_what_depends_on_it(blob, filled, monkeypatch, change, redone):
    before = {entry.path for entry in filled.entries()}
    onboarder = small_onboarder(**change)
    work = Work(onboarder, monkeypatch)
    CachedOnboarding(onboarder, filled)(blob, "another name")
    templates = len(onboarder.viewpoints())
    once = {"PCA", "words"}
    assert work.done == {what: 1 if what in once else templates for what in redone}
    # New files of the kinds that were made again, beside the old ones.
    made = {entry.path for entry in filled.entries()} - before
    assert {path.parent.name for path in made} == redone - {"PCA"}
    assert len(made) == len(redone - {"PCA"})
    # And it is not just any artefact that is taken: the result is that of a run without.
    if len(redone) < len(EVERYTHING) and change.get("batch_size") is None:
        fresh = small_onboarder(**change)
        assert_same(fresh(blob, "another name"), CachedOnboarding(fresh, filled)(blob, "another name"))


def test_another_mesh_shares_nothing(filled, monkeypatch):
    onboarder = small_onboarder()
    work = Work(onboarder, monkeypatch)
    CachedOnboarding(onboarder, filled)(procedural_mesh(4, subdivisions=4), "blob")
    assert work.done.keys() == EVERYTHING


def test_stages_after_onboarding_touch_nothing(tmp_path, blob):
    conf = str(Path(__file__).resolve().parents[2] / "conf")

    def store(*overrides):
        with initialize_config_dir(conf, version_base="1.3"):
            cfg = compose("config", ["extractor=dense_sift", f"representations={tmp_path}", *overrides])
        return build_method(cfg).store

    usual = store()
    for overrides in (
        ["retrieval.num_templates=1"],
        ["matcher=cyclic"],
        ["pnp=epnp_ransac", "pnp.iterations=50"],
        ["refiner=featuremetric", "pipeline.refine=all"],
        ["onboarder.batch_size=2"],
    ):
        changed = store(*overrides)
        assert changed.path(blob, "blob") == usual.path(blob, "blob")
        artefacts = ArtefactStore(tmp_path)
        assert CachedOnboarding(changed.onboarder, artefacts).facts(blob) == CachedOnboarding(
            usual.onboarder, artefacts
        ).facts(blob)
    assert store("bow.sigma=3").path(blob, "blob") != usual.path(blob, "blob")


def transformer():
    """A small transformer with random weights, which has global descriptors."""
    size = {"hidden_size": 48, "num_attention_heads": 3, "num_hidden_layers": 2}
    return DinoV2("vits14_reg", layer=1, seed=0, config=size, weights="random")


@pytest.mark.parametrize(
    ("renderer", "extractor"),
    [
        (RaycastRenderer(), DenseSift()),
        (CoordinateRenderer(), CoordinateCode()),
        (RaycastRenderer(), transformer()),
    ],
    ids=["pictures", "oracle", "transformer"],
)
def test_artefacts_change_no_bit(blob, tmp_path, renderer, extractor):
    onboarder = small_onboarder(renderer=renderer, extractor=extractor, bow=SoftAssignBow(0.5))
    plain = onboarder(blob, "blob")
    assert (plain.template_cls is None) == (not isinstance(extractor, DinoV2))
    cached = CachedOnboarding(onboarder, ArtefactStore(tmp_path))
    assert_same(plain, cached(blob, "blob"))  # filling
    assert_same(plain, cached(blob, "blob"))  # reading
    store = RepresentationStore(tmp_path / "representations", onboarder, ArtefactStore(tmp_path))
    assert_same(plain, store.get(blob, "blob"))


@pytest.mark.gpu
def test_artefacts_on_a_gpu(blob, tmp_path):
    onboarder = small_onboarder().cuda()
    plain = onboarder(blob, "blob")
    cached = CachedOnboarding(onboarder, ArtefactStore(tmp_path))
    for again in (cached(blob, "blob"), cached(blob, "blob")):
        assert all(tensor.is_cuda for tensor in again.state_dict().values())
        for name in ("points_model", "patch_index", "template_offsets", "T_template_from_model"):
            assert torch.equal(getattr(again, name), getattr(plain, name)), name
        torch.testing.assert_close(again.descriptors, plain.descriptors)


@pytest.mark.parametrize(("renderer", "bits"), [(RaycastRenderer(), 8), (CoordinateRenderer(), 16)])
def test_templates_have_the_colours_of_pictures(blob, renderer, bits):
    onboarder = small_onboarder(renderer=renderer)
    seen, rendered = [], []
    renderer.register_forward_hook(lambda _, __, output: rendered.append(output.rgb))
    onboarder.extractor.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    onboarder(blob, "blob")
    assert renderer.bits == bits
    images = torch.cat(seen)
    levels = images.double() * (2**bits - 1)
    assert (levels - levels.round()).abs().max() < 2e-7 * 2**bits
    before = torch.cat([rgb for rgb in rendered if rgb.shape[-1] == SIZE])
    assert 0 < (before - images).abs().max() < 0.51 / (2**bits - 1)


def test_broken_artefacts_are_made_again(blob, tmp_path, monkeypatch):
    artefacts = ArtefactStore(tmp_path)
    onboarder = small_onboarder()
    cached = CachedOnboarding(onboarder, artefacts)
    cached(blob, "blob")
    # What was loaded lies in the files that are about to be damaged.
    plain = onboarder(blob, "blob")
    for broken, redone in (
        (["words"], FITTED),
        (["words", "descriptors"], FITTED | {"descriptors"}),
        (["words", "descriptors", "patches"], FITTED | {"descriptors", "patches"}),
        (["patches"], {"patches"}),
        (KINDS, EVERYTHING),
        (["renderings", "descriptors"], set()),  # nobody asks for them
    ):
        for entry in artefacts.entries():
            if entry.kind in broken:
                os.truncate(entry.path, entry.bytes * 2 // 3)
        with monkeypatch.context() as patch:
            work = Work(onboarder, patch)
            assert_same(plain, cached(blob, "blob"))
        assert work.done.keys() == redone
        _remove_hooks(onboarder)


def _remove_hooks(onboarder):
    for module in onboarder.modules():
        module._forward_pre_hooks.clear()


def test_a_broken_representation_is_made_again(blob, tmp_path):
    store = RepresentationStore(tmp_path, small_onboarder())
    first = store.get(blob, "blob")
    first_state = {name: tensor.clone() for name, tensor in first.state_dict().items()}
    path = store.path(blob, "blob")
    path.write_bytes(path.read_bytes()[:-100])
    again = store.get(blob, "blob")
    assert all(torch.equal(tensor, again.state_dict()[name]) for name, tensor in first_state.items())


def test_progress_tells_the_stages_that_are_run(blob, tmp_path):
    cached = CachedOnboarding(small_onboarder(), ArtefactStore(tmp_path))
    calls = []
    cached(blob, "blob", lambda *call: calls.append(call))
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert stages == ["renderings", "patches", "templates", "PCA", "visual words", "bags of words"]
    for stage in stages:
        done = [call[1] for call in calls if call[0] == stage]
        assert done == sorted(done)
        assert done[-1] == next(call[2] for call in calls if call[0] == stage)
    assert ("templates", 10, 10) in calls
    calls.clear()
    cached(blob, "blob", lambda *call: calls.append(call))
    assert {stage for stage, _, _ in calls} == {"bags of words"}


@pytest.mark.parametrize("with_artefacts", [False, True])
def test_two_processes_onboard_an_object_once(blob, tmp_path, with_artefacts):
    barrier, queue = CONTEXT.Barrier(2), CONTEXT.Queue()
    job = CONTEXT.Process(target=onboard, args=(tmp_path, with_artefacts, barrier, queue))
    job.start()
    onboard(tmp_path, with_artefacts, barrier, queue)  # this process is the other one
    results = [queue.get(timeout=600) for _ in range(2)]
    job.join()
    # Three batches of templates; the renderer renders them and the depths at the patches.
    counts = sorted((tuple(counts.values()) for counts, _, _ in results), reverse=True)
    assert counts == [(6, 3, 1), (0, 0, 0)]
    assert results[0][1:] == results[1][1:]
    files = list((tmp_path / "representations").glob("*.safetensors"))
    assert [str(file) for file in files] == [results[0][2]]
    again = ObjectRepresentation.load(files[0])
    assert float(again.template_bow.double().sum()) == results[0][1]
    torch.testing.assert_close(again.template_bow, small_onboarder()(blob, "blob").template_bow)
    if with_artefacts:
        assert [entry.kind for entry in ArtefactStore(tmp_path / "artefacts").entries()] == KINDS


def test_a_killed_job_loses_only_the_stage_that_it_was_at(blob, tmp_path, monkeypatch):
    job = CONTEXT.Process(target=die_while_writing_descriptors, args=(tmp_path,))
    job.start()
    job.join(timeout=600)
    assert job.exitcode == -signal.SIGKILL
    artefacts = ArtefactStore(tmp_path / "artefacts")
    assert [entry.kind for entry in artefacts.entries()] == ["patches", "renderings"]
    assert not list((tmp_path / "representations").glob("*.safetensors"))
    onboarder = small_onboarder()
    work = Work(onboarder, monkeypatch)
    representation = RepresentationStore(tmp_path / "representations", onboarder, artefacts).get(blob, "blob")
    assert work.done == {"descriptors": 10, "PCA": 1, "words": 1}
    assert_same(representation, small_onboarder()(blob, "blob"))
    assert not list(tmp_path.glob("*/*/.*-*.safetensors"))


def test_what_is_there_needs_no_batch_size(blob, tmp_path):
    artefacts = ArtefactStore(tmp_path)
    first = CachedOnboarding(small_onboarder(batch_size=3), artefacts)(blob, "blob")

    def measured(*_):
        raise AssertionError("the network was run to find a batch size")

    again = small_onboarder(words=VisualWords(24), batch_size="auto")
    again._try_batch = measured
    other = CachedOnboarding(again, artefacts)(blob, "blob")
    assert other.words.shape[0] == 24
    # Nor does it matter for what is computed of it.
    assert torch.equal(first.descriptors, other.descriptors)
    assert_same(
        first, CachedOnboarding(small_onboarder(batch_size=7), ArtefactStore(tmp_path / "b"))(blob, "blob")
    )

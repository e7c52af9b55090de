import inspect
from copy import deepcopy
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf
from pytorch_lightning.strategies import DDPStrategy

from foundpose.bop import BopDataset
from foundpose.config import build_detector, build_method, claim_run_folder, clear_errors
from foundpose.detection import Proposer, RegionProposer
from foundpose.features import DenseSift, PatchExtractor
from foundpose.geometry import PerspectiveCrop
from foundpose.pipeline import DetectAndEstimate, PoseConfidence

CONF = Path(__file__).resolve().parents[1] / "conf"
GROUPS = sorted(
    (group.name, option.stem)
    for group in CONF.iterdir()
    if group.is_dir() and group.name != "experiment"  # each is run in tests/experiments/ablation
    for option in group.glob("*.yaml")
)
MODULES = {
    "renderer",
    "viewpoints",
    "bow",
    "retrieval",
    "matcher",
    "pnp",
    "scorer",
    "hypotheses",
    "pictures",
    "robust_loss",
    "refiner",
}
TOGETHER = sorted({*MODULES, "data", "masks"} - {"hypotheses"})  # none of these changes what another one says
INLINE = ["crop", "projection", "words", "start"]  # of config.yaml
# What makes extractors small; their weights are not here.
SIZES = "hidden_size: 24, num_attention_heads: 2, num_hidden_layers: 1"
SMALL = {
    "dinov2": [f"extractor.config={{{SIZES}}}", "extractor.layer=null"],
    "dino": [f"extractor.config={{{SIZES}, intermediate_size: 24}}"],
    "dinov3": [f"extractor.config={{{SIZES}, intermediate_size: 24}}"],
    "clip": [f"extractor.config={{{SIZES}, intermediate_size: 24}}"],
    "sam": [f"extractor.config={{{SIZES}, mlp_dim: 24, global_attn_indexes: [0]}}"],
    "loftr": [],
    "s2dnet": [],
}
SMALL_SAM = [
    "proposer.variant=sam_vitb",
    "proposer.weights=random",
    "proposer.seed=0",
    "proposer.config={vision_config: {num_hidden_layers: 1, hidden_size: 24, num_attention_heads: 2, "
    "global_attn_indexes: []}}",
]
SMALL_MEGAPOSE = ["megapose.weights=random", "megapose.seed=0", "megapose.width=4"]


@cache
def composed(name, overrides, with_hydra):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, overrides=list(overrides), return_hydra_config=with_hydra)


def load(name="config", *overrides):
    return deepcopy(composed(name, overrides, False))


def load_with_hydra(name, *overrides):
    return deepcopy(composed(name, overrides, True))


def load_with(group, option):
    """The settings with an option of a method's group; each composition has one of every such group."""
    columns = {g: [o for h, o in GROUPS if h == g] for g in TOGETHER}
    k = columns[group].index(option)
    overrides = [f"{g}={options[min(k, len(options) - 1)]}" for g, options in columns.items()]
    return load("config", *overrides, *SMALL_MEGAPOSE)


@pytest.mark.parametrize(("group", "option"), GROUPS)
def test_every_option_is_instantiated_and_has_the_keys_and_defaults_of_its_constructor(
    group, option, tiny_bop, monkeypatch
):
    if group == "loss":  # of a training, not of the method
        assert instantiate(load("train_adapter", f"loss={option}").loss) is not None
        return
    if group == "sweep":  # of settings that exist
        cfg = load_with_hydra("ablate", f"sweep={option}")
        params = cfg.hydra.sweeper.params
        assert params
        for key in params:
            parent, _, name = key.rpartition(".")
            assert key == "experiment" or name in OmegaConf.select(cfg, parent, throw_on_missing=True)
        return
    if group == "launcher":
        cfg = load_with_hydra("ablate", f"launcher={option}")
        names = {"serial": "BasicLauncher", "joblib": "JoblibLauncher", "slurm": "SlurmLauncher"}
        # Hydra checks the settings against the plugin's schema; it lets nobody else instantiate its own launcher.
        settings = OmegaConf.to_container(cfg.hydra.launcher, resolve=True)
        module, _, launcher = settings.pop("_target_").rpartition(".")
        assert launcher == names[option]
        assert getattr(import_module(module), launcher)(**settings) is not None
        if option == "slurm":
            assert (settings["gpus_per_node"], settings["timeout_min"]) == (1, 240)
        return
    if group == "scene":  # of the demo
        overrides = [f"data.root={tiny_bop}", "scene.scene_id=1", "scene.im_id=1", "scene.obj_id=2"]
        cfg = load("demo", f"scene={option}", "extractor=dense_sift", *(overrides if option == "bop" else []))
        assert instantiate(cfg.scene).mask.any()
        return
    if group == "terminal":
        cfg = load_with_hydra("check", "progress=false")
        assert instantiate(cfg.hydra.callbacks.progress) is not None
        assert cfg.hydra.job_logging.handlers.console.stream == "ext://sys.stderr"
        return
    if group == "trainer":  # of an evaluation
        trainer = instantiate(load("evaluate", f"trainer={option}", "trainer.accelerator=cpu").trainer)
        assert isinstance(trainer.strategy, DDPStrategy) == (option == "ddp")
        return
    overrides = [f"{group}={option}"]
    if group == "extractor" and option.startswith(tuple(SMALL)):
        overrides += SMALL[next(name for name in SMALL if option.startswith(name))]
        overrides += ["extractor.weights=random", "extractor.seed=0"]
    cfg = load_with(group, option) if group in TOGETHER else load("config", *overrides, *SMALL_MEGAPOSE)
    if group == "data":
        cfg.data.root, cfg.data.split, cfg.data.models = str(tiny_bop), "test", "models"
    if group in {*MODULES, "extractor", "proposer"}:
        same_as_constructor(cfg[group], DELIBERATE.get((group, option), set()), defaults=group != "extractor")
    if group == "extractor":
        assert isinstance(instantiate(cfg.extractor), PatchExtractor)
        assert cfg.descriptors.sigma == "auto" or cfg.descriptors.sigma > 0
        assert cfg.crop.background in ("keep", "black")
    elif group == "confidence":  # those of an extractor come with it
        assert (option == "none") == (cfg.confidence is None)
        assert option == "none" or cfg.confidence == load("config", f"extractor={option}").confidence
        assert option == "none" or isinstance(instantiate(cfg.confidence), PoseConfidence)
    elif group in MODULES:
        assert instantiate(cfg[group]) is not None
    elif group == "data":
        assert isinstance(instantiate(cfg.data), BopDataset)
    elif group == "proposer":
        if option == "file":
            cfg.proposer.path = str(tiny_bop / "detections" / "cnos-fastsam" / "detections.json")
        elif option == "sam":
            cfg = load("config", *overrides, *SMALL_SAM)
        assert isinstance(instantiate(cfg.proposer), Proposer)
    elif group == "masks" and option == "detect":
        assert cfg.masks.path is None  # found first
    elif group == "masks":
        cfg.data.root = str(tiny_bop)
        assert len(instantiate(cfg.masks)(BopDataset(tiny_bop))) == 3
    else:
        pytest.fail(f"no test instantiates the group {group}")


@pytest.mark.parametrize("name", INLINE)
def test_nodes_of_the_default_are_instantiated(name):
    node = load()[name]
    assert instantiate(node) is not None
    same_as_constructor(node, {"background"}, defaults=True)


def test_the_detector_has_its_constructors_keys():
    cfg = load("config", "extractor=dense_sift")
    for name, given in (("detector", {"extractor"}), ("finder", {"detector", "pipeline"})):
        node = OmegaConf.create(OmegaConf.to_container(cfg[name], resolve=True) | dict.fromkeys(given))
        same_as_constructor(node, given | {"preselection", "dense"}, defaults=True)
    detector = build_detector(cfg, instantiate(cfg.extractor))
    assert isinstance(detector.proposer, RegionProposer)
    finder = instantiate(cfg.finder, detector=detector, pipeline=build_method(cfg).pipeline)
    assert isinstance(finder, DetectAndEstimate)


def test_queries_are_corrupted_and_templates_are_not():
    corruption = load("config", "experiment=oracle_noise").corruption
    assert instantiate(corruption)(DenseSift()).fingerprint() == DenseSift().fingerprint()


APPS = sorted({path.stem for path in CONF.glob("*.yaml")} - {"config"})
WITHOUT_METHOD = {"check", "view", "gpu_check"}


def load_app(name):
    overrides = ["extractor=dense_sift", "words.num_words=32", "descriptors.sigma=0.7"]
    return load_with_hydra(name, f"hydra.job.name={name}", *([] if name in WITHOUT_METHOD else overrides))


@pytest.mark.parametrize("app", APPS)
def test_a_run_has_a_folder_of_its_app(app):
    cfg = load_app(app)
    assert Path(cfg.hydra.run.dir).parts[:2] == ("outputs", app)
    assert not cfg.hydra.job.chdir


def test_the_default_is_the_papers_but_for_what_was_measured():
    cfg = load()
    # Chosen by measurement, the paper has other choices; everything else is the paper's.
    assert (cfg.pnp.solver, cfg.pnp.mirror, cfg.pnp.guidance) == ("p3p", True, 2.0)
    assert (cfg.bow.normalization, cfg.crop.background) == ("hellinger", "black")
    paper = load("config", "experiment=paper")
    own = ["pnp=epnp_ransac", "retrieval=bag_of_words", "start=null", "scorer=inliers"]
    assert load("config", *own, "bow.normalization=cosine", "crop.background=keep") == paper
    assert (cfg.extractor.variant, cfg.descriptors.sigma) == ("vitl14_reg", 10.0)
    assert (cfg.crop.size, cfg.crop.fill, cfg.viewpoints.count) == (420, 0.6, 800)
    assert (cfg.projection.num_components, cfg.words.num_words, cfg.bow.num_nearest) == (256, 2048, 3)
    assert (cfg.retrieval.num_templates, cfg.pnp.iterations, cfg.pnp.threshold) == (5, 400, 10.0)
    assert cfg.bow.sigma == 10.0
    assert cfg.retrieval.retriever.bow == cfg.onboarder.bow


@pytest.mark.parametrize("name", sorted({"config", *APPS} - WITHOUT_METHOD))
def test_every_app_builds_its_method(name, tmp_path):
    cfg = load_app(name)
    cfg.representations = str(tmp_path)
    method = build_method(cfg)
    assert method.onboarder.bow.sigma == method.pipeline.retriever.retriever.bow.sigma == 0.7
    assert method.onboarder.extractor is method.pipeline.extractor
    assert method.onboarder.words.num_words == 32
    assert method.onboarder.image_size == method.pipeline.crop.size


DELIBERATE = {
    # (group, option): keys that are what the option is about.
    ("bow", "hard_assign"): {"num_nearest"},
    ("matcher", "cyclic"): {"mode", "top_k"},
    ("retrieval", "every_template"): {"num_templates"},
    ("matcher", "soft"): {"temperature"},
    ("pnp", "p3p_ransac"): {"guidance"},
    ("pnp", "soft_ransac"): {"guidance"},
    ("pnp", "epnp_ransac"): {"solver", "mirror"},
    ("pnp", "dlt_ransac"): {"solver", "guidance"},
    ("robust_loss", "huber"): {"scale"},
    ("robust_loss", "barron"): {"scale"},
    ("refiner", "featuremetric_views"): {"num_views", "mask_margin"},
}


def same_as_constructor(cfg, deliberate, defaults):
    """The node, and the nodes in it, have their constructors' keys, and their defaults but for deliberate ones."""
    constructor = get_class(cfg._target_)
    parameters = dict(inspect.signature(constructor.__init__).parameters)
    parameters.pop("self")
    if constructor is not torch.nn.Module and all(
        p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters.values()
    ):
        parameters = {}
    assert set(parameters) == {key for key in cfg if not str(key).startswith("_")}
    for name, parameter in parameters.items():
        if OmegaConf.is_dict(cfg[name]) and "_target_" in cfg[name]:
            # A node's defaults may be its parent's choice, as the number of iterations of the polish is.
            same_as_constructor(cfg[name], set(cfg[name]), defaults)
        elif defaults and name not in deliberate and parameter.default is not inspect.Parameter.empty:
            assert cfg[name] == parameter.default, name


def test_a_device_that_is_not_there(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match="use device=cpu"):
        build_method(load("config", "extractor=dense_sift", "device=cuda"))


def test_a_run_folder_keeps_to_its_settings(tmp_path):
    cfg = OmegaConf.create({"a": 1, "device": "cpu"})
    claim_run_folder(tmp_path, cfg)
    claim_run_folder(tmp_path, OmegaConf.create({"a": 1, "device": "cuda"}))
    claim_run_folder(tmp_path, OmegaConf.create({"a": 1}))
    with pytest.raises(ValueError, match=r'(?s)other settings.*-  "a": 1.*\+  "a": 2'):
        claim_run_folder(tmp_path, OmegaConf.create({"a": 2, "device": "cpu"}))


def test_keys_inside_a_node_may_change_too(tmp_path):
    def settings(size, workers):
        return OmegaConf.create({"data": {"size": size, "workers": workers}})

    may_change = ("data.workers", "trainer.devices")
    claim_run_folder(tmp_path, settings(1, 0), may_change)
    claim_run_folder(tmp_path, settings(1, 4), may_change)
    with pytest.raises(ValueError, match="other settings"):
        claim_run_folder(tmp_path, settings(2, 0), may_change)


def test_evaluation_takes_what_its_config_says():
    cfg = load("evaluate")
    for node, runtime in (
        (cfg.data_module, {"dataset", "masks", "objects", "folder", "pictures", "object_ids", "max_images"}),
        (cfg.evaluation, {"pipeline", "objects", "folder"}),
    ):
        parameters = dict(inspect.signature(get_class(node._target_).__init__).parameters)
        assert set(parameters) - {"self"} == runtime | {k for k in node if not k.startswith("_")}
        assert all(parameters[k].default == node[k] for k in node if not k.startswith("_"))


def test_bad_input_is_one_line_that_says_how_to_see_more(capsys, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit) as stop, clear_errors():
        PerspectiveCrop(0)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == "error: size must be at least 2 pixels, got 0 (HYDRA_FULL_ERROR=1 shows where)"


def test_a_mistake_in_a_program_keeps_its_traceback(monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(ValueError, match="need at least one array to stack"), clear_errors():
        np.stack([])

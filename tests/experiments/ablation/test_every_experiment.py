"""Every experiment file runs from mesh to scores, with small random networks in place of those that need weights.

All runs but three are slow tests.
"""

import json

import pytest
from omegaconf import OmegaConf

from ablation.runs import run_folder, run_once
from tests.test_config import CONF, SIZES, SMALL_MEGAPOSE, load
from tests.test_config import SMALL as SMALL_NETWORKS

QUICK = ("paper", "table1_row09", "table2_row04")
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))


def small_network(cfg):
    """Overrides that make an experiment's extractor one that needs no weights, and quick."""
    kind = cfg.extractor._target_.rpartition(".")[2].lower().removesuffix("backbone")
    if kind in ("densesift", "coordinatecode"):
        return []
    common = ["extractor.weights=random", "extractor.seed=0"]
    if kind == "dinov2":
        return [*common, "extractor.layer=0", f"extractor.config={{{SIZES}}}"]
    layer = ["extractor.layer=0"] if cfg.extractor.get("layer") is not None else []
    return common + layer + SMALL_NETWORKS[kind]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Of all runs: they share renderings and descriptors, and experiments that differ in nothing but what is made
    small here are one run."""
    return tmp_path_factory.mktemp("experiments")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in EXPERIMENTS]
)
def test_experiment_runs(name, tiny_bop, folder):
    plain = load("ablate", f"experiment={name}")
    megapose = "MegaPose" in OmegaConf.to_yaml(plain)
    iterations = ["refiner.iterations", "refiners.megapose.iterations"]
    count = ["num_views=2", "num_inplane=4"] if "num_views" in plain.viewpoints else ["count=8"]
    overrides = [
        f"experiment={name}",
        f"data.root={tiny_bop}",
        f"folder={folder}",
        "objects=[1]",
        "max_images=1",
        *(f"viewpoints.{setting}" for setting in count),
        "crop.size=140",
        "words.num_words=16",
        "projection.num_components=16",
        "trainer.accelerator=cpu",
        *small_network(plain),
        *(SMALL_MEGAPOSE if megapose else []),
        *(f"{key}=1" for key in iterations if megapose and OmegaConf.select(plain, key)),
    ]
    cfg = load("ablate", *overrides)
    run = run_folder(cfg)
    record = run_once(cfg, name)  # overrides that a user makes would end the row
    assert record.status == "finished", record.error
    assert record.row == (record.name if record.name.startswith("table") else None)
    random = "weights" in plain.extractor or megapose
    assert (record.label is not None) == random
    assert record.figures["targets"] == 1
    estimates = json.loads((run / "estimates.json").read_text())
    masks = 5 if plain.masks.get("masks_per_instance", 1) == 5 else 1
    assert len(estimates) == min(masks, 2)  # there are two detections


def test_a_row_without_megaposes_weights_says_what_it_lacks(tiny_bop, tmp_path):
    plain = load("ablate", "experiment=table1_row08")
    overrides = [
        "experiment=table1_row08",
        f"data.root={tiny_bop}",
        f"folder={tmp_path}",
        f"megapose.weights={tmp_path / 'absent'}",
        "projection.num_components=16",
        "trainer.accelerator=cpu",
        *small_network(plain),
    ]
    record = run_once(load("ablate", *overrides), "table1_row08")
    assert (record.status, record.row) == ("failed", "table1_row08")
    assert f"no weights at {tmp_path / 'absent'}" in record.error
    assert "refiner-rgb-653307694" in record.error

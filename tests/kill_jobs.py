"""What tests run in processes of their own and kill."""

import hashlib
import os
import runpy
import sys
from pathlib import Path

import pytorch_lightning  # noqa: F401 - the server imports it once, for all jobs that it forks
import torch
from safetensors import safe_open

import foundpose.evaluation  # noqa: F401
from ablation import collect_runs
from foundpose.features import DenseSift
from foundpose.geometry import PerspectiveCrop
from foundpose.onboarding import ArtefactStore, RepresentationStore
from foundpose.rendering import RaycastRenderer
from foundpose.synthetic import procedural_mesh
from foundpose.training import PairSettings, make_pairs
from tests.onboarding.jobs import SIZE, small_onboarder

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
_SMALL = ["viewpoints.count=20", "words.num_words=32", "crop.size=140", "projection.num_components=32"]


def run_job(name, folder, root, ready):
    """Do a job; ``ready`` is set when what is worth killing begins."""
    _alone(folder.parent / f"{folder.name}.log")
    ready.set()
    JOBS[name](folder, root)


def run_app(name, arguments, log):
    """Run an app as the command line would, on one thread; what it and its own processes print goes to ``log``."""
    _alone(log)
    # Processes that it starts run the same file.
    sys.argv = [str(EXPERIMENTS / f"{name}.py"), *arguments]
    runpy.run_path(sys.argv[0], run_name="__main__")


def _alone(log):
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")


def onboard(folder, _):
    store = RepresentationStore(folder / "objects", small_onboarder(), ArtefactStore(folder / "artefacts"))
    for seed in (3, 4):
        store.get(procedural_mesh(seed, subdivisions=4), f"blob{seed}")


def cache_pairs(folder, _):
    onboarder = small_onboarder(renderer=RaycastRenderer(supersampling=1), extractor=DenseSift())
    for seed in range(2):
        settings = PairSettings(crops_per_mesh=2, surface_points=16)
        meshes = [procedural_mesh(11, subdivisions=4)]
        make_pairs(meshes, onboarder, PerspectiveCrop(SIZE), settings, seed, ArtefactStore(folder))


def evaluate(folder, root):
    _app(
        "evaluate",
        root,
        "report=null",
        "data_module.batch_size=1",
        f"hydra.run.dir={folder / 'run'}",
        *_stores(folder),
    )


def ablate(folder, root):
    _app("ablate", root, "pnp.iterations=50,100", f"folder={folder}", *_stores(folder))


def _stores(folder):
    return f"representations={folder / 'objects'}", f"artefacts={folder / 'artefacts'}"


def _app(name, root, *arguments):
    settings = ["extractor=dense_sift", f"data.root={root}", "masks=gt", *_SMALL, "trainer.accelerator=cpu"]
    sys.argv = [f"{name}.py", *(["-m"] if name == "ablate" else []), *settings, *arguments]
    runpy.run_path(str(EXPERIMENTS / f"{name}.py"), run_name="__main__")


def outcome(folder):
    """All that a job leaves, but for times: contents of stored tensors, rows of results, figures of runs."""
    tensors = {str(path.relative_to(folder)): _content(path) for path in folder.rglob("[!.]*.safetensors")}
    rows = {
        str(path.relative_to(folder)): [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]
        for path in folder.rglob("*-test.csv")
    }
    records = collect_runs(folder / "runs") if (folder / "runs").is_dir() else []
    runs = [(run.status, run.figures.get("AR"), run.settings) for run in records]
    return tensors, rows, sorted(runs, key=repr)


def _content(path):
    """What a file says of its tensors, and a hash of each."""
    with safe_open(path, framework="pt") as file:
        values = {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118 - not a mapping
        return file.metadata(), {
            name: hashlib.sha256(value.tobytes()).hexdigest() for name, value in values.items()
        }


JOBS = {"onboarding": onboard, "cache": cache_pairs, "evaluation": evaluate, "ablation": ablate}

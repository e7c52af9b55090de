import gc
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

from foundpose.features import CoordinateCode, PcaProjection
from foundpose.geometry import SuperFibonacci
from foundpose.onboarding import Onboarder, RepresentationStore
from foundpose.rendering import CoordinateRenderer, Mesh
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SoftAssignBow, VisualWords
from foundpose.synthetic import procedural_mesh
from tests.bop_dataset import make_bop_dataset

if "PYTEST_XDIST_WORKER" in os.environ:
    # Processes that share the cores must not each take all of them.
    torch.set_num_threads(1)


# How long an example takes says how busy the machine is.
settings.register_profile("foundpose", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("foundpose")


# What takes longest comes first, so that no process is left with a long file when the others have nothing to do.
LONG = ("experiments", "evaluation", "training", "test_kills.py", "pipeline", "onboarding", "features", "pnp")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files by how long they take, roughly."""

    def rank(item: pytest.Item) -> int:
        room = item.path.relative_to(Path(__file__).parent).parts[0]
        return LONG.index(room) if room in LONG else len(LONG)

    items.sort(key=rank)


def pytest_collection_finish() -> None:
    """Imported modules stay: no search for garbage goes through them again (`tests/__init__.py`)."""
    gc.freeze()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs a GPU where there is none."""
    if item.get_closest_marker("gpu") is not None and not torch.cuda.is_available():
        pytest.skip("needs a GPU")


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """What a test draws without a generator of its own depends on no test before it."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def lmo_root() -> Path:
    """Root of an LM-O (subset) in BOP layout: FOUNDPOSE_LMO, or shared/data/lmo beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "lmo"
    root = Path(os.environ.get("FOUNDPOSE_LMO", default))
    if not (root / "models" / "models_info.json").is_file():
        pytest.skip(f"no LM-O data at {root}; set FOUNDPOSE_LMO to the root of a BOP copy of LM-O")
    return root


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def tiny_bop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A BOP dataset of two procedural objects and three pictures."""
    return make_bop_dataset(tmp_path_factory.mktemp("bop") / "tiny")


@pytest.fixture(scope="session")
def blob() -> Mesh:
    """A procedural mesh of 10 k vertices."""
    return procedural_mesh(3, subdivisions=5)


@pytest.fixture(scope="session")
def oracle_onboarder() -> Onboarder:
    """Onboards with codes of true coordinates, 100 templates and 200 words."""
    return Onboarder(
        CoordinateRenderer(),
        CoordinateCode(),
        SuperFibonacci(100),
        VisualWords(200),
        SoftAssignBow(),
        projection=PcaProjection(64),
    )


@pytest.fixture(scope="session")
def representations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of objects that all test processes share: whoever needs one first onboards it."""
    folder = tmp_path_factory.getbasetemp()
    return (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "representations"


@pytest.fixture(scope="session")
def oracle_blob(blob: Mesh, oracle_onboarder: Onboarder, representations: Path) -> ObjectRepresentation:
    """Representation of the blob under the oracle."""
    return RepresentationStore(representations, oracle_onboarder).get(blob, "blob")


@pytest.fixture(scope="session")
def other_mesh() -> Mesh:
    """A procedural mesh of 2.5 k vertices."""
    return procedural_mesh(8, subdivisions=4)


@pytest.fixture(scope="session")
def oracle_other(
    other_mesh: Mesh, oracle_onboarder: Onboarder, representations: Path
) -> ObjectRepresentation:
    """Its representation under the oracle."""
    return RepresentationStore(representations, oracle_onboarder).get(other_mesh, "other")

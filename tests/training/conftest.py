import pytest

from foundpose.features import DenseSift, PcaProjection
from foundpose.geometry import PerspectiveCrop, SuperFibonacci
from foundpose.onboarding import Onboarder
from foundpose.rendering import RaycastRenderer
from foundpose.retrieval import SoftAssignBow, VisualWords
from foundpose.synthetic import LightVariation, procedural_mesh
from foundpose.training import PairSettings, make_pairs

SIZE = 280


@pytest.fixture(scope="session")
def bodies():
    """Two procedural objects of 2.5 k vertices."""
    return [procedural_mesh(seed, subdivisions=4) for seed in (11, 12)]


@pytest.fixture(scope="session")
def sift_onboarder():
    return Onboarder(
        RaycastRenderer(supersampling=1),
        DenseSift(),
        SuperFibonacci(40),
        VisualWords(64),
        SoftAssignBow(0.3),
        PcaProjection(64),
        image_size=SIZE,
    )


@pytest.fixture(scope="session")
def crop():
    return PerspectiveCrop(SIZE)


@pytest.fixture(scope="session")
def settings():
    return PairSettings(
        crops_per_mesh=8, templates_per_crop=2, max_degrees=30.0, light=LightVariation(), surface_points=64
    )


@pytest.fixture(scope="session")
def pairs(bodies, sift_onboarder, crop, settings):
    return make_pairs(bodies, sift_onboarder, crop, settings, seed=3)

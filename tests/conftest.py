import os
from pathlib import Path

import numpy as np
import pytest
import torch


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


def random_rotations(count: int, seed: int = 0) -> torch.Tensor:
    """Uniformly random rotations (count, 3, 3), float64."""
    q = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    return quaternion_to_rotation_matrix(q)

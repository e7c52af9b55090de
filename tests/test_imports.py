"""What importing the library does not import."""

import subprocess
import sys

import pytest

CODE = """
import sys
sys.modules["torchvision"] = None  # makes every import of it fail
import foundpose.features
import foundpose, foundpose.evaluation.objects, foundpose.evaluation.report, foundpose.synthetic
assert not {"transformers", "pytorch_lightning", "pandas", "matplotlib"} & set(sys.modules), sys.modules.keys()
import torch
from tests.features.backbones import make
for name in ("dinov3", "clip", "sam", "loftr", "s2dnet"):
    make(name)(torch.rand(1, 3, 28, 28))
"""


@pytest.mark.slow
def test_heavy_packages_come_with_what_needs_them_and_torchvision_never() -> None:
    """Also not where it is installed: transformers would use it if asked for an image processor."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]

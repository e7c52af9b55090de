import time

import pytest
import torch
from torch import nn

from foundpose.utils.timing import StageTimer


class Sleep(nn.Module):
    def forward(self, seconds, fail=False):
        time.sleep(seconds)
        if fail:
            raise RuntimeError("failed")
        return torch.zeros(1)


def test_times_add_up_by_module_and_end_with_the_context():
    slow, fast = Sleep(), Sleep()
    with StageTimer({"slow": slow, "fast": fast}) as timer:
        for _ in range(2):
            slow(0.05)
        fast(0.01)
        with pytest.raises(RuntimeError, match="failed"):
            fast(0.01, fail=True)
    slow(0.05)
    assert timer.calls == {"slow": 2, "fast": 2}
    assert timer.seconds["slow"] >= 0.1
    assert timer.seconds["fast"] >= 0.02

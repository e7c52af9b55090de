"""Stand-ins for trained networks."""

import torch
from torch import Tensor, nn

from foundpose.refinement import RenderAndCompareRefiner, UpdateNetwork, update_between


class Constant(nn.Module):
    """Predicts the same for all pictures; remembers them."""

    def __init__(self, *values: float) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values))
        self.seen: list[Tensor] = []

    def forward(self, pictures: Tensor) -> Tensor:
        self.seen.append(pictures)
        return self.values.expand(len(pictures), -1)


class Oracle(RenderAndCompareRefiner):
    """Predicts a share of the update that leads to given poses."""

    def aim(self, T_true: Tensor, share: float = 1.0) -> "Oracle":
        self.T_true, self.share = T_true, share
        return self

    def predict(self, views):
        truth = views.T_view_from_camera @ self.T_true
        update = update_between(views.T_view_from_model, truth, views.K, views.centre)
        identity = update.new_tensor([0, 0, 1.0, 1, 0, 0, 0, 1, 0])
        return identity + self.share * (update - identity), None


def small_network(**changes):
    return UpdateNetwork(**({"width": 8, "grid": 8, "reach": 2, "hidden": 16} | changes))


def stirred_network(**changes):
    """With an output that depends on the pictures."""
    network = small_network(**changes)
    with torch.no_grad():
        network.output.weight.normal_(0.0, 0.02, generator=torch.Generator().manual_seed(1))
    return network

"""What matching returns."""

from typing import NamedTuple

from torch import Tensor


class Matches(NamedTuple):
    """Matches of the patches of B crops to the patches of h templates each.

    Attributes:
        template_patch: (B, h, P) index into the template's (padded) patches, int64; 0 where not valid.
        distance: (B, h, P) Euclidean distance of the descriptors; +inf where not valid.
        valid: (B, h, P) bool.
    """

    template_patch: Tensor
    distance: Tensor
    valid: Tensor

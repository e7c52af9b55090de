"""An extractor whose answers are prepared."""

from torch import Tensor

from benchmarking.sizes import PATCH, WorkloadSizes
from foundpose.features import PatchExtractor, PatchFeatures
from foundpose.features.base import Fingerprint


class ScriptedExtractor(PatchExtractor):
    """Returns prepared descriptors, after it has run another extractor, if one is given, for the time that takes.

    Args:
        sizes: of the workload.
        features: (B, C, g, g) descriptors of the crops.
        backbone: runs on the crops, its output is thrown away.
    """

    features: Tensor

    def __init__(
        self, sizes: WorkloadSizes, features: Tensor, backbone: PatchExtractor | None = None
    ) -> None:
        super().__init__(sizes.channels, PATCH, (PATCH - 1) / 2)
        self.register_buffer("features", features)
        self.backbone = backbone
        self._identity = self.identity(sizes)

    def forward(self, images: Tensor) -> PatchFeatures:
        """Prepared descriptors, whatever the images show; not differentiable w.r.t. them."""
        if self.backbone is not None:
            self.backbone(images)
        return PatchFeatures(self.features, None)

    def fingerprint(self) -> Fingerprint:
        """The workload's seed and sizes."""
        return self._identity

    @staticmethod
    def identity(sizes: WorkloadSizes) -> Fingerprint:
        """The fingerprint for some sizes."""
        return {"extractor": "ScriptedExtractor", "channels": sizes.channels, "seed": sizes.seed}

"""How large a workload is."""

import math
from dataclasses import dataclass

PATCH = 14
"""Distance of patch centres in pixels."""


@dataclass(frozen=True)
class WorkloadSizes:
    """How large a workload is; the default is the paper's setting with a ViT-S.

    Attributes:
        templates: number of templates T.
        patches: about how many valid patches a template and a crop have.
        components: PCA dimension d.
        channels: length C of a raw descriptor.
        words: number of visual words k.
        crop_size: side S of crops and templates in pixels, a multiple of 14.
        batch_size: number of crops B.
        images: number of pictures that the crops are cut from, at most B.
        image_size: (height, width) of the pictures.
        outliers: share of the crops' patches that are noise.
        seed: of everything random.
    """

    templates: int = 800
    patches: int = 300
    components: int = 256
    channels: int = 384
    words: int = 2048
    crop_size: int = 420
    batch_size: int = 1
    images: int = 1
    image_size: tuple[int, int] = (480, 640)
    outliers: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("templates", "patches", "components", "channels", "words", "batch_size", "images"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.crop_size < 2 * PATCH or self.crop_size % PATCH:
            raise ValueError(f"crop_size must be a multiple of {PATCH} px, at least 28; got {self.crop_size}")
        most = math.floor(0.7 * self.grid**2)
        if self.patches > most:
            raise ValueError(
                f"patches must be at most {most} of the {self.grid}² of a crop of {self.crop_size} px, "
                f"got {self.patches}"
            )
        if self.components > self.channels:
            raise ValueError(f"components ({self.components}) must not exceed channels ({self.channels})")
        if self.words > self.templates * self.patches // 2:
            raise ValueError(
                f"words must be at most half of templates * patches ({self.templates * self.patches // 2}), "
                f"got {self.words}"
            )
        if self.images > self.batch_size:
            raise ValueError(f"images ({self.images}) must not exceed batch_size ({self.batch_size})")
        if not 0.0 <= self.outliers < 1.0:
            raise ValueError(f"outliers must lie in [0, 1), got {self.outliers}")

    @property
    def grid(self) -> int:
        """Number of patches along the side of a crop."""
        return self.crop_size // PATCH

    @property
    def fill(self) -> float:
        """Share of a crop's side that the object takes, so that about ``patches`` of its patches see it."""
        return math.sqrt(4.0 * self.patches / math.pi / 0.95) / self.grid

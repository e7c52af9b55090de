"""Facts about a representation that are not tensors."""

from dataclasses import dataclass, field

from foundpose.features.base import Fingerprint
from foundpose.geometry.patch_grid import PatchGrid

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class RepresentationInfo:
    """Facts about a representation that are not tensors.

    Attributes:
        name: the object's name.
        diameter: largest distance between two mesh vertices, mesh units.
        mesh_checksum: checksum of the mesh that was onboarded.
        extractor: fingerprint of the extractor that made the descriptors.
        image_size: side of a template in pixels.
        stride: distance of patch centres in pixels.
        offset: coordinate of the first patch centre in pixels.
        grid: number of patches along a side.
        settings: further settings of the onboarding, for the record.
        schema_version: version of the file format.
        scales: of the descriptors, by name, see :class:`foundpose.onboarding.scales.DescriptorScales`; those that the
            templates do not show are left out.
    """

    name: str
    diameter: float
    mesh_checksum: str
    extractor: Fingerprint
    image_size: int
    stride: float
    offset: float
    grid: int
    settings: dict[str, str | int | float | bool | None] = field(default_factory=dict)
    schema_version: int = SCHEMA_VERSION
    scales: dict[str, float] = field(default_factory=dict)

    @property
    def patch_grid(self) -> PatchGrid:
        """Where the patches of the templates lie."""
        return PatchGrid(self.stride, self.offset, self.grid)

    def scale(self, name: str, setting: str) -> float:
        """A scale of the descriptors, for a setting that is "auto".

        Raises:
            ValueError: it was not measured; the message says which setting to set.
        """
        if name not in self.scales:
            raise ValueError(
                f"{setting} is auto, but the representation of {self.name!r} has no measured scale {name!r}: "
                f"onboard the object again, with more templates if there were few, or set {setting} to a number"
            )
        return self.scales[name]

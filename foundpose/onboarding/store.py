"""A folder of object representations."""

from pathlib import Path

from foundpose.onboarding.artefacts import ArtefactStore, load_or_make
from foundpose.onboarding.cached import CachedOnboarding
from foundpose.onboarding.onboarder import Onboarder
from foundpose.onboarding.stages import Progress
from foundpose.rendering import Mesh
from foundpose.representation import ObjectRepresentation
from foundpose.representation.info import SCHEMA_VERSION
from foundpose.utils.settings import digest


class RepresentationStore:
    """Keeps representations on disk, one file for each object and way of onboarding it.

    A file's name carries a hash of the mesh, the extractor and all settings that the representation depends on,
    so other settings never meet an old file. Files are written whole or not at all, and of several processes that ask
    for the same object at once a single one onboards it.

    Args:
        folder: where the files lie; made when needed.
        onboarder: makes what is missing.
        artefacts: keeps what the stages of onboarding made, for representations that share some of the settings;
            None keeps nothing.
        mmap: map files into memory, so that opening one takes a millisecond and only what is used of it takes memory;
            False reads them whole, see :meth:`ObjectRepresentation.load`.
    """

    def __init__(
        self,
        folder: str | Path,
        onboarder: Onboarder,
        artefacts: ArtefactStore | None = None,
        mmap: bool = True,
    ) -> None:
        self.folder = Path(folder)
        self.onboarder = onboarder
        self.mmap = mmap
        self._fingerprint = onboarder.extractor.fingerprint()
        self._make: Onboarder | CachedOnboarding = onboarder
        if artefacts is not None:
            self._make = CachedOnboarding(onboarder, artefacts, self._fingerprint)

    def path(self, mesh: Mesh, name: str) -> Path:
        """File of an object under the onboarder's settings, whether it exists or not."""
        return self.path_of(mesh.checksum, name)

    def path_of(self, checksum: str, name: str) -> Path:
        """As :meth:`path`, for those who know a mesh's checksum and need not load it."""
        facts = {
            "schema": SCHEMA_VERSION,
            "mesh": checksum,
            "extractor": self._fingerprint,
            "precision": self.onboarder.extractor.running_precision(),
            "settings": self.onboarder.settings(),
        }
        return self.folder / f"{name}-{digest(facts)[:12]}.safetensors"

    def has(self, mesh: Mesh, name: str) -> bool:
        """Whether the object is onboarded already."""
        return self.path(mesh, name).is_file()

    def get(self, mesh: Mesh, name: str, progress: Progress | None = None) -> ObjectRepresentation:
        """Load the object's representation, or onboard the object and save it; a broken file is made again."""
        representation = load_or_make(
            self.path(mesh, name),
            self._load,
            lambda path: self._make(mesh, name, progress).save(path),
        )
        representation.check_extractor(self._fingerprint)
        return representation

    def find(self, checksum: str, name: str) -> ObjectRepresentation | None:
        """Load the representation of the mesh with a checksum; None where it is missing or its file is broken."""
        representation = self._load(self.path_of(checksum, name))
        if representation is not None:
            representation.check_extractor(self._fingerprint)
        return representation

    def _load(self, path: Path) -> ObjectRepresentation | None:
        """A representation; None where the file is missing or broken."""
        try:
            return ObjectRepresentation.load(path, mmap=self.mmap)
        except (FileNotFoundError, ValueError):
            return None

"""A folder of object representations."""

import hashlib
import json
from pathlib import Path

from foundpose.onboarding.onboarder import Onboarder, Progress
from foundpose.onboarding.representation import SCHEMA_VERSION, ObjectRepresentation
from foundpose.rendering import Mesh


class RepresentationStore:
    """Keeps representations on disk, one file for each object and way of onboarding it.

    A file's name carries a hash of the mesh, the extractor and all settings that the representation depends on,
    so other settings never meet an old file. Files are written whole or not at all.

    Args:
        folder: where the files lie; made when needed.
        onboarder: makes what is missing.
    """

    def __init__(self, folder: str | Path, onboarder: Onboarder) -> None:
        self.folder = Path(folder)
        self.onboarder = onboarder
        self._fingerprint = onboarder.extractor.fingerprint()

    def path(self, mesh: Mesh, name: str) -> Path:
        """File of an object under the onboarder's settings, whether it exists or not."""
        facts = {
            "schema": SCHEMA_VERSION,
            "mesh": mesh.checksum,
            "extractor": self._fingerprint,
            "settings": self.onboarder.settings(),
        }
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
        return self.folder / f"{name}-{digest[:12]}.safetensors"

    def has(self, mesh: Mesh, name: str) -> bool:
        """Whether the object is onboarded already."""
        return self.path(mesh, name).is_file()

    def get(self, mesh: Mesh, name: str, progress: Progress | None = None) -> ObjectRepresentation:
        """Load the object's representation, or onboard the object and save it."""
        path = self.path(mesh, name)
        if not path.is_file():
            self.onboarder(mesh, name, progress).save(path)
        representation = ObjectRepresentation.load(path)
        representation.check_extractor(self._fingerprint)
        return representation

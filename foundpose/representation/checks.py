"""Whether objects were onboarded with the extractor at hand."""

from foundpose.features.base import Fingerprint, PatchExtractor
from foundpose.representation.info import RepresentationInfo
from foundpose.representation.object_representation import ObjectRepresentation


class ExtractorChecks:
    """Checks once for each representation that it was made with the extractor at hand.

    A fingerprint may cost a pass over all weights, so it is taken when an object or an extractor is new. Training the
    extractor after that is the caller's business.
    """

    def __init__(self, capacity: int = 1024) -> None:
        self.capacity = capacity
        self._extractor: PatchExtractor | None = None
        self._fingerprint: Fingerprint = {}
        self._passed: list[RepresentationInfo] = []

    def __call__(self, representation: ObjectRepresentation, extractor: PatchExtractor) -> bool:
        """Raise ValueError for another extractor; say whether the representation had not been seen before."""
        if extractor is not self._extractor:
            self._extractor, self._fingerprint, self._passed = extractor, extractor.fingerprint(), []
        if any(info is representation.info for info in self._passed):
            return False
        if representation.info.extractor != self._fingerprint:
            self._fingerprint = extractor.fingerprint()
        representation.check_extractor(self._fingerprint)
        self._passed = [*self._passed, representation.info][-self.capacity :]
        return True

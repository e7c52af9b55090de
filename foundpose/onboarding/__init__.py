"""From a mesh to an object representation."""

from foundpose.onboarding.artefacts import ArtefactEntry, ArtefactStore
from foundpose.onboarding.cached import CachedOnboarding
from foundpose.onboarding.onboarder import Onboarder
from foundpose.onboarding.stages import Progress
from foundpose.onboarding.store import RepresentationStore
from foundpose.onboarding.templates import TemplateCameras, register_patches, template_cameras

__all__ = [
    "ArtefactEntry",
    "ArtefactStore",
    "CachedOnboarding",
    "Onboarder",
    "Progress",
    "RepresentationStore",
    "TemplateCameras",
    "register_patches",
    "template_cameras",
]

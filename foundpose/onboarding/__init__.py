"""From a mesh to an object representation."""

from foundpose.onboarding.onboarder import Onboarder, Progress
from foundpose.onboarding.representation import (
    ObjectRepresentation,
    RepresentationInfo,
    TemplatePatches,
    read_info,
)
from foundpose.onboarding.store import RepresentationStore
from foundpose.onboarding.templates import TemplateCameras, register_patches, template_cameras

__all__ = [
    "ObjectRepresentation",
    "Onboarder",
    "Progress",
    "RepresentationInfo",
    "RepresentationStore",
    "TemplateCameras",
    "TemplatePatches",
    "read_info",
    "register_patches",
    "template_cameras",
]

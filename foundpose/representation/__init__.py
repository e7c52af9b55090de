"""What is known of an object, and how it is stored."""

from foundpose.representation.object_representation import (
    ObjectRepresentation,
    RepresentationInfo,
    TemplatePatches,
    read_info,
)

__all__ = ["ObjectRepresentation", "RepresentationInfo", "TemplatePatches", "read_info"]

"""What is known of an object, and how it is stored."""

from foundpose.representation.groups import ObjectGroups, take_rows
from foundpose.representation.object_representation import (
    ObjectRepresentation,
    RepresentationInfo,
    TemplatePatches,
    read_info,
)

__all__ = [
    "ObjectGroups",
    "ObjectRepresentation",
    "RepresentationInfo",
    "TemplatePatches",
    "read_info",
    "take_rows",
]

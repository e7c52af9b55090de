"""What is known of an object, and how it is stored."""

from foundpose.representation.checks import ExtractorChecks
from foundpose.representation.groups import ObjectGroups, take_rows
from foundpose.representation.info import RepresentationInfo
from foundpose.representation.object_representation import ObjectRepresentation, TemplatePatches

__all__ = [
    "ExtractorChecks",
    "ObjectGroups",
    "ObjectRepresentation",
    "RepresentationInfo",
    "TemplatePatches",
    "take_rows",
]

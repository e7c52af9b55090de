"""Crop-to-template patch matching."""

from foundpose.matching.base import Matches
from foundpose.matching.matcher import PatchMatcher
from foundpose.matching.soft import SoftPatchMatcher

__all__ = ["Matches", "PatchMatcher", "SoftPatchMatcher"]

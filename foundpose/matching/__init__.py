"""Crop-to-template patch matching."""

from foundpose.matching.base import Matcher, Matches
from foundpose.matching.matcher import PatchMatcher
from foundpose.matching.soft import SoftPatchMatcher

__all__ = ["Matcher", "Matches", "PatchMatcher", "SoftPatchMatcher"]

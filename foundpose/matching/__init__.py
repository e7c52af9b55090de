"""Crop-to-template patch matching."""

from foundpose.matching.base import Matches
from foundpose.matching.matcher import PatchMatcher

__all__ = ["Matches", "PatchMatcher"]

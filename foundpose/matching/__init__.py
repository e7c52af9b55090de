"""Crop-to-template patch matching."""

"""Overlays, template strips and matches as images."""

from foundpose.visualization.figure import ShownObject, save_estimate_figure
from foundpose.visualization.overlay import COARSE, TRUTH, draw_axes, draw_contour

__all__ = ["COARSE", "TRUTH", "ShownObject", "draw_axes", "draw_contour", "save_estimate_figure"]

"""Overlays, template strips and matches as images."""

from foundpose.visualization.figure import overlay_pose, save_estimate_figure
from foundpose.visualization.overlay import COARSE, TRUTH, draw_axes, draw_contour

__all__ = ["COARSE", "TRUTH", "draw_axes", "draw_contour", "overlay_pose", "save_estimate_figure"]

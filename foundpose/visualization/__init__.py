"""Contours, axes and captioned tiles as pictures."""

from foundpose.visualization.overlay import (
    COARSE,
    REFINED,
    TRUTH,
    draw_axes,
    draw_contour,
    draw_instances,
    to_pil,
)

__all__ = ["COARSE", "REFINED", "TRUTH", "draw_axes", "draw_contour", "draw_instances", "to_pil"]

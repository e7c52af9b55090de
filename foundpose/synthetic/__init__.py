"""Procedural objects and pictures."""

from foundpose.synthetic.scenes import (
    LightVariation,
    SyntheticScene,
    cluttered_scene,
    combine_seeds,
    procedural_mesh,
    random_rotation,
)

__all__ = [
    "LightVariation",
    "SyntheticScene",
    "cluttered_scene",
    "combine_seeds",
    "procedural_mesh",
    "random_rotation",
]

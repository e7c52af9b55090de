"""Optimisation: robust losses, batched Levenberg-Marquardt on SE(3) and gradients of its optimum."""

from foundpose.optimization.barron import BarronLoss
from foundpose.optimization.implicit import (
    Differentiation,
    ImplicitPose,
    attach_implicit_gradient,
    optimise_pose,
)
from foundpose.optimization.levenberg_marquardt import (
    LevenbergMarquardtResult,
    NormalEquations,
    levenberg_marquardt,
)
from foundpose.optimization.robust import Huber, LeastSquares, RobustLoss

__all__ = [
    "BarronLoss",
    "Differentiation",
    "Huber",
    "ImplicitPose",
    "LeastSquares",
    "LevenbergMarquardtResult",
    "NormalEquations",
    "RobustLoss",
    "attach_implicit_gradient",
    "levenberg_marquardt",
    "optimise_pose",
]

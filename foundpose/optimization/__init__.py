"""Optimisation: robust losses and batched Levenberg-Marquardt on SE(3)."""

from foundpose.optimization.levenberg_marquardt import (
    LevenbergMarquardtResult,
    NormalEquations,
    levenberg_marquardt,
)
from foundpose.optimization.robust import Huber, RobustLoss

__all__ = ["Huber", "LevenbergMarquardtResult", "NormalEquations", "RobustLoss", "levenberg_marquardt"]

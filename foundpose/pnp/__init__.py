"""Perspective-n-Point: minimal solvers, RANSAC, differentiable polish."""

from foundpose.pnp.epnp import solve_epnp
from foundpose.pnp.levenberg_marquardt import LevenbergMarquardtPnp, PnpOptimum
from foundpose.pnp.p3p import P3PSolutions, solve_p3p
from foundpose.pnp.problem import MinimalSolution, PnpProblem
from foundpose.pnp.ransac import PnpResult, PnpStatus, RansacPnp
from foundpose.pnp.soft_selection import PoseCandidates, SoftInlierSelection
from foundpose.pnp.template_pose import TemplatePoses, TopTemplatePose
from foundpose.pnp.template_start import TemplateStart

__all__ = [
    "LevenbergMarquardtPnp",
    "MinimalSolution",
    "P3PSolutions",
    "PnpOptimum",
    "PnpProblem",
    "PnpResult",
    "PnpStatus",
    "PoseCandidates",
    "RansacPnp",
    "SoftInlierSelection",
    "TemplatePoses",
    "TemplateStart",
    "TopTemplatePose",
    "solve_epnp",
    "solve_p3p",
]

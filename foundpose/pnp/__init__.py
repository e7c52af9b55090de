"""Perspective-n-Point: minimal solvers, RANSAC and polish."""

from foundpose.pnp.epnp import MinimalSolution, solve_epnp
from foundpose.pnp.polish import polish_pnp
from foundpose.pnp.ransac import PnpResult, PnpStatus, RansacPnp

__all__ = ["MinimalSolution", "PnpResult", "PnpStatus", "RansacPnp", "polish_pnp", "solve_epnp"]

"""The local optimisation of RANSAC's poses: polished on their inliers, which are selected anew, in turns."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.pnp.cost import select_inliers
from foundpose.pnp.levenberg_marquardt import LevenbergMarquardtPnp
from foundpose.pnp.problem import PnpProblem
from foundpose.pnp.weak_perspective import mirrored_poses

# Decrease of the cost, as a share of it, whose step is the last of a polish whose inliers will be selected anew.
_ROUGH = 1e-2
# Steps that a mirrored pose is given to show that it is the better one.
_MIRROR_STEPS = 4
# A rough start's inliers are those within so many thresholds, and it is given so many steps on them, in turn.
_WIDE = (2.8, 1.4)
_WIDE_STEPS = 4
# Below so many inliers there is nothing to polish on.
_LEAST_POLISHED = 4


class OptimisedPoses(NamedTuple):
    """Poses and their inliers.

    Attributes:
        T: (P, 4, 4).
        inliers: (P, N) bool.
        regular: (P,) bool, which have a gradient; told in gradient mode only, all true without.
    """

    T: Tensor
    inliers: Tensor
    regular: Tensor


class _State(NamedTuple):
    """Poses (P, 4, 4), their inliers (P, N), the inliers that they were polished on, and truncated costs (P,)."""

    T: Tensor
    inliers: Tensor
    used: Tensor
    cost: Tensor


@dataclass(frozen=True)
class LocalOptimization:
    """How poses are polished on their inliers.

    Args:
        polish: one polish.
        threshold: of an inlier, pixels.
        rounds: how often the inliers are selected anew.
        mirror: also polish each pose's mirror image in depth and keep the better one.

    Source: Chum, Matas and Kittler, "Locally optimized RANSAC", 2003.
    """

    polish: LevenbergMarquardtPnp
    threshold: float
    rounds: int
    mirror: bool

    def __call__(self, T: Tensor, found: Tensor, problem: PnpProblem) -> OptimisedPoses:
        """Polish poses (P, 4, 4) of P clean problems, where there are any (P,)."""
        unrolled = self.polish.differentiation == "unrolled" and torch.is_grad_enabled()
        with torch.set_grad_enabled(unrolled):
            rounds = self.rounds - 1
            state = self._climb(self._select(T, problem), found, problem, rounds)
            if self.mirror:
                mirrored = mirrored_poses(state.T, problem.points_model, problem.only(state.inliers).weights)
                start = self._select(mirrored, problem)
                # A solid object does not look like its mirror image: most problems end here.
                alike = found & (4 * start.inliers.sum(-1) >= 3 * state.inliers.sum(-1))
                other = self._climb(start, alike, problem, min(rounds, 1), _MIRROR_STEPS)
                better = alike & (other.cost < state.cost)
                state = self._climb(_where(better, other, state), better, problem, rounds - 1)
            if self.rounds > 0:
                state, _ = self._polish_once(state, found, problem)
        T, regular = state.T, torch.ones_like(found)
        if torch.is_grad_enabled() and not unrolled:
            # The optimum is that of the inliers polished on, which the last selection may have changed.
            T, regular = self.polish.attach_gradient(T, problem.only(state.used & found.unsqueeze(-1)))
        return OptimisedPoses(T, state.inliers & found.unsqueeze(-1), regular)

    def approach(self, T: Tensor, problem: PnpProblem) -> Tensor:
        """Rough poses (P, 4, 4), polished on what lies within a few times the threshold; a constant."""
        with torch.no_grad():
            for factor in _WIDE:
                inliers, _ = select_inliers(T, problem, factor * self.threshold, self.polish.loss)
                enough = inliers.sum(-1) >= _LEAST_POLISHED
                rough, _ = self.polish.optimise(T, problem.only(inliers), _ROUGH, _WIDE_STEPS, clean=True)
                T = torch.where(enough[:, None, None], rough.T, T)
        return T

    def _select(self, T: Tensor, problem: PnpProblem) -> _State:
        inliers, cost = select_inliers(T, problem, self.threshold, self.polish.loss)
        return _State(T, inliers, inliers, cost)

    def _climb(
        self, state: _State, active: Tensor, problem: PnpProblem, rounds: int, steps: int | None = None
    ) -> _State:
        """Polish roughly on the inliers and select them anew, in turns, as long as they change."""
        for _ in range(rounds):
            rows = active.nonzero().squeeze(-1)
            if rows.numel() == 0:
                break
            before = _State(*(x[rows] for x in state))
            after, better = self._polish_once(before, active[rows], problem.take(rows), _ROUGH, steps)
            state = _State(*(x.index_copy(0, rows, y) for x, y in zip(state, after, strict=True)))
            changed = (after.inliers != before.inliers).any(-1)
            active = active.index_copy(0, rows, better & changed)
        return state

    def _polish_once(
        self,
        before: _State,
        active: Tensor,
        problem: PnpProblem,
        tolerance: float | None = None,
        steps: int | None = None,
    ) -> tuple[_State, Tensor]:
        """Polish poses on their inliers, and select these anew, where that does not raise the truncated cost (P,)."""
        T = self.polish.optimise(before.T, problem.only(before.inliers), tolerance, steps, clean=True)[0].T
        after = self._select(T, problem)._replace(used=before.inliers)
        # Equal but for rounding counts as equal, or rounding would decide whether the last polish is kept.
        most = before.cost * (1.0 + 64.0 * torch.finfo(before.cost.dtype).eps)
        enough = torch.minimum(after.inliers.sum(-1), before.inliers.sum(-1)) >= _LEAST_POLISHED
        better = active & enough & (after.cost <= most)
        return _where(better, after, before), better


def _where(condition: Tensor, a: _State, b: _State) -> _State:
    """Rows of ``a`` where the condition (P,) holds, else of ``b``."""
    return _State(
        *(torch.where(condition.reshape(-1, *[1] * (x.dim() - 1)), x, y) for x, y in zip(a, b, strict=True))
    )

"""Fitting probabilities to what turned out right, and saying how far they can be trusted."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from foundpose.pipeline.confidence import PoseConfidence
from foundpose.pipeline.results import PoseEvidence


def fit_confidence(
    evidence: PoseEvidence, right: Tensor, decay: float = 1.0, share_right: float | None = None
) -> PoseConfidence:
    """Logistic regression by Newton's method.

    Args:
        evidence: of N poses.
        right: (N,) bool, which of them are right.
        decay: half the factor of the squared weights of standardised evidence, beside the sum over all poses.
        share_right: share of poses that are right where the confidence will be used, if it is known to differ: what
            a right pose looks like is taken to be the same there, so that only the bias moves, by the difference of
            log odds.

    Raises:
        ValueError: all poses are right, or none; evidence that is not finite; or a share that is not in (0, 1).

    Differentiable w.r.t. nothing.

    Source: Saerens et al., "Adjusting the Outputs of a Classifier to New a Priori Probabilities", 2002 (the share).
    """
    if share_right is not None and not 0 < share_right < 1:
        raise ValueError(f"share_right must be between 0 and 1, got {share_right}")
    if bool(right.all()) or not bool(right.any()):
        raise ValueError(f"{int(right.sum())} of {len(right)} poses are right: both kinds are needed to fit")
    x = torch.stack(evidence, dim=1).double()
    if not bool(torch.isfinite(x).all()):
        raise ValueError("the evidence holds numbers that are not finite")
    mean, spread = x.mean(0), x.std(0).clamp(min=1e-6)
    x = torch.cat([(x - mean) / spread, torch.ones_like(x[:, :1])], dim=1)
    ridge = 2.0 * decay * torch.ones(x.shape[1], dtype=x.dtype)
    ridge[-1] = 0.0
    w = torch.zeros_like(ridge)
    for _ in range(50):
        p = torch.sigmoid(x @ w)
        gradient = x.T @ (p - right.double()) + ridge * w
        hessian = (x * (p * (1 - p))[:, None]).T @ x + torch.diag(ridge + 1e-9)
        step = torch.linalg.solve(hessian, gradient)
        # A step of Newton's may be too long where nearly all is certain.
        w = w - step * min(1.0, 4.0 / float(step.norm().clamp(min=1e-12)))
        if float(step.norm()) < 1e-10:
            break
    weights = w[:-1] / spread
    names = dict(zip(PoseEvidence._fields, weights.tolist(), strict=True))
    moved = 0.0 if share_right is None else _log_odds(share_right) - _log_odds(float(right.double().mean()))
    return PoseConfidence(names, float(w[-1] - weights @ mean) + moved)


def _log_odds(share: float) -> float:
    return math.log(share / (1.0 - share))


class Reliability(NamedTuple):
    """Probabilities against what turned out right.

    Attributes:
        edges: (k + 1,) of the bins of probability.
        count: (k,) poses in each.
        probability: (k,) their mean probability; NaN where there are none.
        share: (k,) share of them that are right; NaN where there are none.
        error: expected calibration error: mean of |share − probability| over all poses.
        brier: mean squared difference of probability and truth (0 or 1).
    """

    edges: Tensor
    count: Tensor  # type: ignore[assignment]  # hides tuple.count
    probability: Tensor
    share: Tensor
    error: float
    brier: float

    def to_json(self) -> dict[str, Any]:
        """Plain numbers; None where a bin is empty."""
        rows = zip(self.count.tolist(), self.probability.tolist(), self.share.tolist(), strict=True)
        bins = [
            {"poses": n, "probability": p if n else None, "right": share if n else None}
            for n, p, share in rows
        ]
        return {
            "poses": int(self.count.sum()),
            "expected_calibration_error": self.error,
            "brier": self.brier,
            "edges": self.edges.tolist(),
            "bins": bins,
        }

    def table(self) -> str:
        """A short table, a row for each bin that holds poses."""
        lines = ["probability  poses   mean  right"]
        for k in torch.nonzero(self.count).flatten().tolist():
            low, high = self.edges[k : k + 2].tolist()
            mean, share = float(self.probability[k]), float(self.share[k])
            lines.append(f"{low:5.1f} – {high:.1f}  {int(self.count[k]):5d}  {mean:.3f}  {share:.3f}")
        lines.append(f"expected calibration error {self.error:.3f}, Brier score {self.brier:.3f}")
        return "\n".join(lines)


def reliability(probability: Tensor, right: Tensor, bins: int = 10) -> Reliability:
    """Compare probabilities with what turned out right.

    Args:
        probability: (N,) in [0, 1].
        right: (N,) bool.
        bins: of equal width.

    Raises:
        ValueError: no poses, or shapes that differ.
    """
    if probability.shape != right.shape or probability.dim() != 1 or not len(right):
        raise ValueError(
            "probability and right must have shape (N,) with N at least 1, got "
            f"{tuple(probability.shape)} and {tuple(right.shape)}"
        )
    p, y = probability.double(), right.double()
    place = (p * bins).long().clamp(max=bins - 1)

    def sums(values: Tensor) -> Tensor:
        return torch.zeros(bins, dtype=torch.float64).index_add(0, place, values)

    count = sums(torch.ones_like(p))
    mean, share = sums(p) / count, sums(y) / count
    error = float(((share - mean).abs().nan_to_num() * count).sum() / len(p))
    edges = torch.linspace(0.0, 1.0, bins + 1, dtype=torch.float64)
    return Reliability(edges, count.long(), mean, share, error, float((p - y).square().mean()))

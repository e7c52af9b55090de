"""RANSAC around a minimal solver, for a batch of Perspective-n-Point problems."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry.cameras import pixel_rays
from foundpose.geometry.transforms import make_transform
from foundpose.pnp.levenberg_marquardt import LevenbergMarquardtPnp
from foundpose.pnp.polish import check_correspondences, invertible_intrinsics, usable_coordinates
from foundpose.pnp.sampling import Hypotheses, SolverName, sample_hypotheses, sample_size
from foundpose.pnp.scoring import reprojection_errors, select_inliers
from foundpose.pnp.soft_selection import PoseCandidates, SoftInlierSelection
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


class PnpStatus(IntEnum):
    """What became of a problem.

    OK: a pose with enough inliers.
    TOO_FEW_CORRESPONDENCES: fewer valid correspondences than a minimal sample has.
    DEGENERATE: no sample determined a pose (collinear or coincident points, an intrinsic matrix without inverse).
    BEHIND_CAMERA: samples determined poses, but none with its points in front of the camera.
    TOO_FEW_INLIERS: the best pose has fewer inliers than asked for.
    """

    OK = 0
    TOO_FEW_CORRESPONDENCES = 1
    DEGENERATE = 2
    BEHIND_CAMERA = 3
    TOO_FEW_INLIERS = 4


class PnpResult(NamedTuple):
    """Poses from 2D-3D correspondences.

    Attributes:
        T_camera_from_model: (B, 4, 4), always finite. Where ``success`` is False it is the best pose found, or
            one that puts the object upright in front of the camera when there is none: test the flag.
        inliers: (B, N) bool, valid correspondences in front of the camera within the threshold.
        num_inliers: (B,) int64, the pose's quality.
        success: (B,) bool, ``status`` is OK.
        status: (B,) int64, values of :class:`PnpStatus`.
        reprojection_rmse: (B,) root mean square distance of the inliers in pixels; infinite without inliers.
        regular: (B,) bool, the pose has an implicit gradient; elsewhere it is zero. Told in gradient mode only, all
            true without.
        candidates: the hypotheses of a soft selection, or None without one.
    """

    T_camera_from_model: Tensor
    inliers: Tensor
    num_inliers: Tensor
    success: Tensor
    status: Tensor
    reprojection_rmse: Tensor
    regular: Tensor
    candidates: PoseCandidates | None = None


class RansacPnp(nn.Module):
    """Robust pose from 2D-3D correspondences: minimal samples, inlier count, polish on the inliers.

    A problem's random samples depend on the seed and on its own number of valid correspondences only, and all
    decisions are made per problem: neighbours, padding, batch size and device do not change a result.

    Args:
        solver: minimal solver: "p3p" on three of four correspondences with the fourth to choose the root, "epnp" on
            four (the paper's), or "dlt" on six, kornia's direct linear transform, which flat objects defeat.
        iterations: samples drawn for each problem.
        threshold: largest distance of an inlier's projection from its pixel, in pixels.
        min_inliers: poses with fewer inliers are flagged. (A sample always fits itself.)
        confidence: stop a problem's sampling once an all-inlier sample has been drawn with this probability,
            judged by the best inlier ratio so far; None draws all samples.
        polish_rounds: how often the inliers are selected anew and the pose polished on them.
        mirror: also polish each pose's mirror image in depth and keep the better one: the projections of a flat
            object hardly tell the two apart, and samples often fall for the wrong one.
        polish: how; it decides on the robust loss and on the kind of gradient. None means
            ``LevenbergMarquardtPnp(max_iterations=10)``.
        soft_selection: also return the best hypotheses with the probability of choosing them, for losses on the
            expected pose error (DSAC). The pose returned is the same as without.
        guidance: how much samples prefer correspondences of high priority, where priorities are given: the rank of
            each member is that of a uniform one raised to this power (as a share of the ranks). 1: no preference.
        seed: seed of the samples.
        score_points: at most this many correspondences of a problem, evenly spread, score its samples; None means
            all. The polish and the inliers returned are always those of all correspondences.
        chunk: samples of a problem solved and scored at once; bounds the memory to about B · chunk · (4 N + 300)
            numbers. None chooses by the batch and the device. It has no influence on the result.

    Source: paper, section "Pose estimation from 2D-3D correspondences"; Fischler and Bolles, "Random sample
    consensus", 1981; the local optimisation follows Chum, Matas and Kittler, "Locally optimized RANSAC", 2003.
    """

    draws: Tensor
    guided_draws: Tensor

    def __init__(
        self,
        solver: SolverName = "p3p",
        iterations: int = 400,
        threshold: float = 10.0,
        min_inliers: int = 6,
        confidence: float | None = 0.9999,
        polish_rounds: int = 3,
        mirror: bool = True,
        polish: LevenbergMarquardtPnp | None = None,
        soft_selection: SoftInlierSelection | None = None,
        seed: int = 0,
        score_points: int | None = 128,
        chunk: int | None = None,
        guidance: float = 1.0,
    ) -> None:
        super().__init__()
        size = sample_size(solver)
        if not guidance >= 1:
            raise ValueError(f"guidance must be at least 1, got {guidance}")
        if iterations < 1 or (chunk is not None and chunk < 1):
            raise ValueError(f"iterations and chunk must be at least 1, got {iterations} and {chunk}")
        if score_points is not None and score_points < size:
            raise ValueError(f"score_points must be at least {size} or None, got {score_points}")
        if not threshold > 0:
            raise ValueError(f"threshold must be positive (pixels), got {threshold}")
        if min_inliers < size:
            raise ValueError(f"min_inliers must be at least {size}, got {min_inliers}")
        if confidence is not None and not 0 < confidence < 1:
            raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
        if polish_rounds < 0:
            raise ValueError(f"polish_rounds must be at least 0, got {polish_rounds}")
        self.solver: SolverName = solver
        self.sample_size = size
        self.threshold = threshold
        self.min_inliers = min_inliers
        self.confidence = confidence
        self.polish_rounds = polish_rounds
        self.mirror = mirror
        self.polish = LevenbergMarquardtPnp(max_iterations=10) if polish is None else polish
        self.soft_selection = soft_selection
        self.score_points = score_points
        self.chunk = chunk
        self.guidance = guidance
        generator = torch.Generator().manual_seed(seed)
        # Integers, so that every device turns them into the same indices.
        draws = torch.randint(2**31, (iterations, size), generator=generator)
        self.register_buffer("draws", draws, persistent=False)
        # Of ranks by priority: the smaller, the better.
        guided = ((draws.double() / 2**31) ** guidance * 2**31).long()
        self.register_buffer("guided_draws", guided, persistent=False)

    def forward(
        self,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        valid: Tensor | None = None,
        weights: Tensor | None = None,
        priority: Tensor | None = None,
    ) -> PnpResult:
        """Estimate one pose per problem.

        Args:
            points_image: (B, N, 2) pixels.
            points_model: (B, N, 3) mesh units.
            K: (B, 3, 3) intrinsics.
            valid: (B, N) bool, which correspondences exist; None means all. Those with coordinates that are
                not finite, or too large to be squared, do not count either.
            weights: (B, N), how much each counts in the polish; None means all the same. Those whose weight is not
                positive (or no number) do not exist. Sampling and inlier counts do not look at weights, a soft
                selection does.
            priority: (B, N), the larger the more often a correspondence is sampled (see ``guidance``); None: all
                alike. Only their order counts.

        Returns:
            A :class:`PnpResult`.

        Raises:
            ValueError: shapes or dtypes do not fit.

        Differentiable w.r.t. ``points_image``, ``points_model``, ``K``, ``weights`` and the parameters of the
        polish's loss: the poses (and ``reprojection_rmse``) have the gradient of the optimum on the selected inliers,
        by default by the implicit function theorem. Sampling, and which correspondences are inliers, are choices and
        have no gradient; ``candidates`` makes up for that. Without polish (``polish_rounds=0``), or where it did not
        help, the gradient is that of one Newton step on the inliers (unrolled: there is none).
        """
        check_correspondences(points_image, points_model, K, valid, name="valid")
        check_correspondences(points_image, points_model, K, weights)
        check_correspondences(points_image, points_model, K, priority, name="priority")
        # Autocast would run the matrix products in half precision, too coarse for poses.
        with torch.autocast(points_image.device.type, enabled=False):
            return self._estimate(points_image, points_model, K, valid, weights, priority)

    def _estimate(
        self,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        valid: Tensor | None,
        weights: Tensor | None,
        priority: Tensor | None,
    ) -> PnpResult:
        invertible = invertible_intrinsics(K)
        K, valid, problem = self._problem(points_image, points_model, K, valid, weights)
        points_image, points_model, weights = problem.points_image, problem.points_model, problem.weights
        count = valid.sum(-1)
        usable = (count >= self.sample_size) & invertible
        hypotheses = self._sample(points_image, points_model, K, valid, usable, priority)
        kept = hypotheses.T.shape[1]
        found = hypotheses.quality.flatten() >= 0
        T = torch.where(
            found[:, None, None],
            hypotheses.T.flatten(0, 1),
            _pose_in_front(points_model.detach(), valid).repeat_interleave(kept, dim=0),
        )
        T, inliers, regular = self._polish(T, found, problem.repeat(kept))
        found = found.unflatten(0, (-1, kept))
        candidates = None
        if self.soft_selection is not None:
            candidates = self.soft_selection(
                T.unflatten(0, (-1, kept)),
                found,
                points_image,
                points_model,
                K,
                valid,
                self.threshold,
                weights,
            )
        # The first hypothesis is the best.
        T, inliers, regular, found = T[::kept], inliers[::kept], regular[::kept], found[:, 0]

        return self._result(T, inliers, regular, found, hypotheses.determined, count, problem, candidates)

    def _problem(
        self,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        valid: Tensor | None,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor, "_Problem"]:
        """Intrinsics as they are usable, which correspondences exist, and all of it without what does not."""
        K = torch.where(
            invertible_intrinsics(K)[:, None, None], K, torch.eye(3, dtype=K.dtype, device=K.device)
        )
        rays = pixel_rays(points_image.detach(), K.detach())
        sane = usable_coordinates(points_image) & usable_coordinates(points_model) & usable_coordinates(rays)
        valid = sane if valid is None else sane & valid.bool()
        if weights is not None:
            weights = weights.to(points_image.dtype)
            valid = valid & (weights > 0) & torch.isfinite(weights)
            weights = weights.masked_fill(~valid, 0.0)
        points_image = points_image.masked_fill(~valid.unsqueeze(-1), 0.0)
        points_model = points_model.masked_fill(~valid.unsqueeze(-1), 0.0)
        return K, valid, _Problem(points_image, points_model, K, valid, weights)

    def _result(
        self,
        T: Tensor,
        inliers: Tensor,
        regular: Tensor,
        found: Tensor,
        determined: Tensor,
        count: Tensor,
        problem: "_Problem",
        candidates: PoseCandidates | None,
    ) -> PnpResult:
        """Polished poses with their statuses and errors."""
        num_inliers = inliers.sum(-1)
        status = torch.full_like(num_inliers, int(PnpStatus.OK))
        status = status.masked_fill(num_inliers < self.min_inliers, int(PnpStatus.TOO_FEW_INLIERS))
        status = status.masked_fill(~found, int(PnpStatus.BEHIND_CAMERA))
        status = status.masked_fill(~determined, int(PnpStatus.DEGENERATE))
        status = status.masked_fill(count < self.sample_size, int(PnpStatus.TOO_FEW_CORRESPONDENCES))
        squared, _ = reprojection_errors(T, *problem[:3])
        mean = torch.where(inliers, squared, torch.zeros_like(squared)).sum(-1) / num_inliers.clamp(min=1)
        # The clamp keeps the square root's derivative finite for data that fit exactly.
        rmse = mean.clamp(min=torch.finfo(mean.dtype).tiny).sqrt()
        rmse = rmse.masked_fill(num_inliers == 0, torch.inf)
        success = status == int(PnpStatus.OK)
        return PnpResult(T, inliers, num_inliers, success, status, rmse, regular, candidates)

    def polish_starts(
        self,
        T: Tensor,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        valid: Tensor,
        weights: Tensor | None = None,
    ) -> PnpResult:
        """Polish rough poses on their inliers, in place of sampling.

        Args:
            T: (B, 4, 4) poses; inliers are first looked for at a few times the threshold.
            points_image: (B, N, 2) pixels.
            points_model: (B, N, 3) mesh units.
            K: (B, 3, 3) intrinsics.
            valid: (B, N) bool.
            weights: (B, N), see :meth:`forward`.

        Returns:
            As :meth:`forward`, without ``candidates``.

        Raises:
            ValueError: shapes or dtypes do not fit.

        Differentiable as :meth:`forward`; the starts are constants.
        """
        check_correspondences(points_image, points_model, K, valid, name="valid")
        check_correspondences(points_image, points_model, K, weights)
        with torch.autocast(points_image.device.type, enabled=False):
            invertible = invertible_intrinsics(K)
            K, valid, problem = self._problem(points_image, points_model, K, valid, weights)
            T = T.detach().to(problem.K)
            sane = torch.isfinite(T).all(-1).all(-1)
            T = torch.where(sane[:, None, None], T, _pose_in_front(problem.points_model.detach(), valid))
            with torch.no_grad():
                for factor in _WIDE:
                    inliers, _ = select_inliers(
                        T, *problem[:4], factor * self.threshold, problem.weights, self.polish.loss
                    )
                    enough = inliers.sum(-1) >= _LEAST_POLISHED
                    rough = self.polish.optimise(T, *problem[:3], problem.weigh(inliers), _ROUGH, _WIDE_STEPS)
                    T = torch.where(enough[:, None, None], rough[0].T, T)
            count = valid.sum(-1)
            found = sane & invertible & (count >= self.sample_size)
            T, inliers, regular = self._polish(T, found, problem, mirror=False)
            return self._result(T, inliers, regular, found, torch.ones_like(found), count, problem, None)

    def _sample(
        self,
        points_image: Tensor,
        points_model: Tensor,
        K: Tensor,
        valid: Tensor,
        usable: Tensor,
        priority: Tensor | None,
    ) -> Hypotheses:
        guide = priority.detach() if priority is not None and self.guidance > 1.0 else None
        return sample_hypotheses(
            points_image.detach(),
            points_model.detach(),
            K.detach(),
            valid,
            usable,
            self.draws if guide is None else self.guided_draws,
            priority=guide,
            solver=self.solver,
            threshold=self.threshold,
            confidence=self.confidence,
            chunk=self.chunk,
            score_points=self.score_points,
            keep=1 if self.soft_selection is None else self.soft_selection.num_candidates,
        )

    def _polish(
        self, T: Tensor, found: Tensor, problem: "_Problem", mirror: bool = True
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Polish poses (P, 4, 4) on their inliers; return them, the inliers (P, N) that they end up with, and which
        have a gradient (P,)."""
        unrolled = self.polish.differentiation == "unrolled" and torch.is_grad_enabled()
        with torch.set_grad_enabled(unrolled):
            rounds = self.polish_rounds - 1
            state = self._climb(_Polished(T, *self._select(T, problem)), found, problem, rounds)
            if self.mirror and mirror:
                mirrored = mirrored_poses(state.T, problem.points_model, problem.weigh(state.inliers))
                start = _Polished(mirrored, *self._select(mirrored, problem))
                # A solid object does not look like its mirror image: most problems end here.
                alike = found & (4 * start.inliers.sum(-1) >= 3 * state.inliers.sum(-1))
                other = self._climb(start, alike, problem, min(rounds, 1), _MIRROR_STEPS)
                better = alike & (other.cost < state.cost)
                state = self._climb(_where(better, other, state), better, problem, rounds - 1)
            if self.polish_rounds > 0:
                state, _ = self._polish_once(state, found, problem)
        T, regular = state.T, torch.ones_like(found)
        if torch.is_grad_enabled() and not unrolled:
            # The optimum is that of the inliers polished on, which the last selection may have changed.
            used = problem.weigh(state.used & found.unsqueeze(-1))
            T, regular = self.polish.attach_gradient(T, *problem[:3], used)
        return T, state.inliers & found.unsqueeze(-1), regular

    def _select(self, T: Tensor, problem: "_Problem") -> tuple[Tensor, Tensor, Tensor]:
        """Inliers of poses, twice, and truncated costs."""
        inliers, cost = select_inliers(T, *problem[:4], self.threshold, problem.weights, self.polish.loss)
        return inliers, inliers, cost

    def _climb(
        self,
        state: "_Polished",
        active: Tensor,
        problem: "_Problem",
        rounds: int,
        steps: int | None = None,
    ) -> "_Polished":
        """Polish roughly on the inliers and select them anew, in turns, as long as they change."""
        for _ in range(rounds):
            rows = active.nonzero().squeeze(-1)
            if rows.numel() == 0:
                break
            before = _Polished(*(x[rows] for x in state))
            after, better = self._polish_once(before, active[rows], problem.take(rows), _ROUGH, steps)
            state = _Polished(*(x.index_copy(0, rows, y) for x, y in zip(state, after, strict=True)))
            changed = (after.inliers != before.inliers).any(-1)
            active = active.index_copy(0, rows, better & changed)
        return state

    def _polish_once(
        self,
        before: "_Polished",
        active: Tensor,
        problem: "_Problem",
        tolerance: float | None = None,
        steps: int | None = None,
    ) -> tuple["_Polished", Tensor]:
        """Polish poses on their inliers, and select these anew, where that does not raise the truncated cost (P,)."""
        weights = problem.weigh(before.inliers)
        T = self.polish.optimise(before.T, *problem[:3], weights, tolerance, steps)[0].T
        inliers, _, cost = self._select(T, problem)
        # Equal but for rounding counts as equal, or rounding would decide whether the last polish is kept.
        most = before.cost * (1.0 + 64.0 * torch.finfo(cost.dtype).eps)
        enough = torch.minimum(inliers.sum(-1), before.inliers.sum(-1)) >= _LEAST_POLISHED
        better = active & enough & (cost <= most)
        return _where(better, _Polished(T, inliers, before.inliers, cost), before), better


class _Problem(NamedTuple):
    """Correspondences of P problems."""

    points_image: Tensor
    points_model: Tensor
    K: Tensor
    valid: Tensor
    weights: Tensor | None

    def take(self, rows: Tensor) -> "_Problem":
        """Some of the problems."""
        weights = None if self.weights is None else self.weights[rows]
        return _Problem(
            self.points_image[rows], self.points_model[rows], self.K[rows], self.valid[rows], weights
        )

    def repeat(self, times: int) -> "_Problem":
        """Each problem several times in a row."""
        if times == 1:
            return self
        return self.take(torch.arange(len(self.K), device=self.K.device).repeat_interleave(times))

    def weigh(self, inliers: Tensor) -> Tensor:
        """Weights (P, N) of inliers, zero elsewhere."""
        return inliers.to(self.K.dtype) if self.weights is None else inliers * self.weights


class _Polished(NamedTuple):
    """Poses (P, 4, 4), their inliers (P, N), the inliers that they were polished on, and truncated costs (P,)."""

    T: Tensor
    inliers: Tensor
    used: Tensor
    cost: Tensor


def _where(condition: Tensor, a: _Polished, b: _Polished) -> _Polished:
    """Rows of ``a`` where the condition (P,) holds, else of ``b``."""
    return _Polished(
        *(torch.where(condition.reshape(-1, *[1] * (x.dim() - 1)), x, y) for x, y in zip(a, b, strict=True))
    )


def _pose_in_front(points_model: Tensor, valid: Tensor) -> Tensor:
    """Identity rotation with the whole object in front of the camera: the finite stand-in for no pose."""
    reach = torch.linalg.vector_norm(points_model, dim=-1).masked_fill(~valid, 0.0).sum(-1)
    depth = 1.0 + 2.0 * reach
    t = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], dim=-1)
    R = torch.eye(3, dtype=t.dtype, device=t.device).expand(*t.shape[:-1], 3, 3)
    return make_transform(R, t)

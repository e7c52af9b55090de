"""RANSAC around a minimal solver, for a batch of Perspective-n-Point problems."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry.transforms import make_transform
from foundpose.pnp.cost import reprojection_errors
from foundpose.pnp.levenberg_marquardt import LevenbergMarquardtPnp
from foundpose.pnp.local_optimization import LocalOptimization, OptimisedPoses
from foundpose.pnp.problem import PnpProblem
from foundpose.pnp.sampling import Sampling, SolverName, sample_hypotheses, sample_size
from foundpose.pnp.soft_selection import PoseCandidates, SoftInlierSelection


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

    def forward(self, problem: PnpProblem, priority: Tensor | None = None) -> PnpResult:
        """Estimate one pose per problem.

        Args:
            problem: B problems of N correspondences. Those with coordinates that are not finite, or too large to be
                squared, or a weight that is not positive, do not exist. Sampling and inlier counts do not look at
                weights, polish and soft selection do.
            priority: (B, N), the larger the more often a correspondence is sampled (see ``guidance``); None: all
                alike. Only their order counts.

        Returns:
            A :class:`PnpResult`.

        Raises:
            ValueError: ``priority`` does not fit.

        Differentiable w.r.t. the problem's points, ``K`` and weights, and the parameters of the polish's loss: the
        poses (and ``reprojection_rmse``) have the gradient of the optimum on the selected inliers, by default by the
        implicit function theorem. Sampling, and which correspondences are inliers, are choices and have no gradient;
        ``candidates`` makes up for that. Without polish (``polish_rounds=0``), or where it did not help, the gradient
        is that of one Newton step on the inliers (unrolled: there is none).
        """
        if priority is not None:
            problem.check_numbers("priority", priority)
        # Autocast would run the matrix products in half precision, too coarse for poses.
        with torch.autocast(problem.K.device.type, enabled=False):
            problem, invertible = problem.clean()
            usable = (problem.valid.sum(-1) >= self.sample_size) & invertible
            guide = priority.detach() if priority is not None and self.guidance > 1.0 else None
            draws = self.draws if guide is None else self.guided_draws
            hypotheses = sample_hypotheses(problem.detach(), usable, draws, self._sampling(), guide)
            kept = hypotheses.T.shape[1]
            found = hypotheses.quality >= 0
            stand_in = _pose_in_front(problem).unsqueeze(1)
            T = torch.where(found[..., None, None], hypotheses.T, stand_in).flatten(0, 1)
            poses = self._local(self.mirror)(T, found.flatten(), problem.repeat(kept))
            candidates = None
            if self.soft_selection is not None:
                T = poses.T.unflatten(0, (-1, kept))
                candidates = self.soft_selection(T, found, problem, self.threshold)
            # The first hypothesis is the best.
            best = OptimisedPoses(*(x[::kept] for x in poses))
            return self._result(best, problem, found[:, 0], hypotheses.determined, candidates)

    def polish_starts(self, T: Tensor, problem: PnpProblem) -> PnpResult:
        """Polish rough poses on their inliers, in place of sampling.

        Args:
            T: (B, 4, 4) poses; inliers are first looked for at a few times the threshold.
            problem: see :meth:`forward`.

        Returns:
            As :meth:`forward`, without ``candidates``.

        Differentiable as :meth:`forward`; the starts are constants.
        """
        with torch.autocast(problem.K.device.type, enabled=False):
            problem, invertible = problem.clean()
            T = T.detach().to(problem.K)
            sane = torch.isfinite(T).all(-1).all(-1)
            local = self._local(mirror=False)
            T = local.approach(torch.where(sane[:, None, None], T, _pose_in_front(problem)), problem)
            found = sane & invertible & (problem.valid.sum(-1) >= self.sample_size)
            poses = local(T, found, problem)
            return self._result(poses, problem, found, torch.ones_like(found))

    def _sampling(self) -> Sampling:
        return Sampling(
            solver=self.solver,
            threshold=self.threshold,
            confidence=self.confidence,
            chunk=self.chunk,
            score_points=self.score_points,
            keep=1 if self.soft_selection is None else self.soft_selection.num_candidates,
        )

    def _local(self, mirror: bool) -> LocalOptimization:
        return LocalOptimization(self.polish, self.threshold, self.polish_rounds, mirror)

    def _result(
        self,
        poses: OptimisedPoses,
        problem: PnpProblem,
        found: Tensor,
        determined: Tensor,
        candidates: PoseCandidates | None = None,
    ) -> PnpResult:
        """Polished poses with their statuses and errors."""
        T, inliers, regular = poses
        num_inliers = inliers.sum(-1)
        status = torch.full_like(num_inliers, int(PnpStatus.OK))
        for failed, code in (
            (num_inliers < self.min_inliers, PnpStatus.TOO_FEW_INLIERS),
            (~found, PnpStatus.BEHIND_CAMERA),
            (~determined, PnpStatus.DEGENERATE),
            (problem.valid.sum(-1) < self.sample_size, PnpStatus.TOO_FEW_CORRESPONDENCES),
        ):
            status = status.masked_fill(failed, int(code))
        squared, _ = reprojection_errors(T, problem)
        mean = torch.where(inliers, squared, torch.zeros_like(squared)).sum(-1) / num_inliers.clamp(min=1)
        # The clamp keeps the square root's derivative finite for data that fit exactly.
        rmse = mean.clamp(min=torch.finfo(mean.dtype).tiny).sqrt()
        rmse = rmse.masked_fill(num_inliers == 0, torch.inf)
        success = status == int(PnpStatus.OK)
        return PnpResult(T, inliers, num_inliers, success, status, rmse, regular, candidates)


def _pose_in_front(problem: PnpProblem) -> Tensor:
    """Identity rotation with the whole object in front of the camera: the finite stand-in for no pose."""
    # What is not valid in a clean problem is zero.
    reach = torch.linalg.vector_norm(problem.points_model.detach(), dim=-1).sum(-1)
    depth = 1.0 + 2.0 * reach
    t = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], dim=-1)
    return make_transform(torch.eye(3, dtype=t.dtype, device=t.device).expand(len(t), 3, 3), t)

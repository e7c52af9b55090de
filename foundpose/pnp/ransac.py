"""RANSAC around the minimal solver, for a batch of Perspective-n-Point problems."""

import math
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry.cameras import pixel_rays
from foundpose.geometry.transforms import make_transform
from foundpose.optimization.robust import RobustLoss
from foundpose.pnp.epnp import solve_epnp_minimal
from foundpose.pnp.polish import check_correspondences, polish_pnp, usable_coordinates
from foundpose.pnp.scoring import reprojection_errors, score_poses, select_inliers

_SAMPLE = 4


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
    """

    T_camera_from_model: Tensor
    inliers: Tensor
    num_inliers: Tensor
    success: Tensor
    status: Tensor
    reprojection_rmse: Tensor


class RansacPnp(nn.Module):
    """Robust pose from 2D-3D correspondences: EPnP on minimal samples, inlier count, polish on the inliers.

    A problem's random samples depend on the seed and on its own number of valid correspondences only, and all
    decisions are made per problem: neighbours, padding, batch size and device do not change a result.

    Args:
        iterations: samples of four correspondences drawn for each problem.
        threshold: largest distance of an inlier's projection from its pixel, in pixels.
        min_inliers: poses with fewer inliers are flagged. (Four points always fit themselves.)
        confidence: stop a problem's sampling once an all-inlier sample has been drawn with this probability,
            judged by the best inlier ratio so far; None draws all samples.
        polish_rounds: how often the inliers are selected anew and the pose polished on them.
        polish_iterations: Levenberg-Marquardt iterations in each round.
        loss: robust loss of the polish on squared pixel distances; None means least squares.
        seed: seed of the samples.
        chunk: samples solved and scored at once; bounds the memory to about 30 · B · chunk · N numbers, and
            sampling stops at its multiples.

    Source: paper, section "Pose estimation from 2D-3D correspondences"; Fischler and Bolles, "Random sample
    consensus", 1981; the local optimisation follows Chum, Matas and Kittler, "Locally optimized RANSAC", 2003.
    """

    draws: Tensor

    def __init__(
        self,
        iterations: int = 400,
        threshold: float = 10.0,
        min_inliers: int = 6,
        confidence: float | None = 0.9999,
        polish_rounds: int = 3,
        polish_iterations: int = 10,
        loss: RobustLoss | None = None,
        seed: int = 0,
        chunk: int = 50,
    ) -> None:
        super().__init__()
        if iterations < 1 or chunk < 1:
            raise ValueError(f"iterations and chunk must be at least 1, got {iterations} and {chunk}")
        if not threshold > 0:
            raise ValueError(f"threshold must be positive (pixels), got {threshold}")
        if min_inliers < _SAMPLE:
            raise ValueError(f"min_inliers must be at least {_SAMPLE}, got {min_inliers}")
        if confidence is not None and not 0 < confidence < 1:
            raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
        if polish_rounds < 0 or polish_iterations < 1:
            raise ValueError(
                "polish_rounds must be at least 0 and polish_iterations at least 1, "
                f"got {polish_rounds} and {polish_iterations}"
            )
        self.threshold = threshold
        self.min_inliers = min_inliers
        self.confidence = confidence
        self.polish_rounds = polish_rounds
        self.polish_iterations = polish_iterations
        self.loss = loss
        self.chunk = chunk
        generator = torch.Generator().manual_seed(seed)
        # Integers, so that every device turns them into the same indices.
        draws = torch.randint(2**31, (iterations, _SAMPLE), generator=generator)
        self.register_buffer("draws", draws, persistent=False)

    def forward(
        self, points_image: Tensor, points_model: Tensor, K: Tensor, valid: Tensor | None = None
    ) -> PnpResult:
        """Estimate one pose per problem.

        Args:
            points_image: (B, N, 2) pixels.
            points_model: (B, N, 3) mesh units.
            K: (B, 3, 3) intrinsics.
            valid: (B, N) bool, which correspondences exist; None means all. Those with coordinates that are
                not finite, or too large to be squared, do not count either.

        Returns:
            A :class:`PnpResult`.

        Raises:
            ValueError: shapes or dtypes do not fit.

        Differentiable w.r.t. ``points_image``, ``points_model`` and ``K`` through the polish on the selected
        inliers (its steps are unrolled). Sampling and selection work on detached copies: they choose, and a
        choice has no gradient.
        """
        check_correspondences(points_image, points_model, K, valid, name="valid")
        # Autocast would run the matrix products in half precision, too coarse for poses.
        with torch.autocast(points_image.device.type, enabled=False):
            return self._estimate(points_image, points_model, K, valid)

    def _estimate(
        self, points_image: Tensor, points_model: Tensor, K: Tensor, valid: Tensor | None
    ) -> PnpResult:
        determinant = torch.linalg.det(K.detach())
        invertible = torch.isfinite(determinant) & (determinant.abs() > 0)
        K = torch.where(invertible[:, None, None], K, torch.eye(3, dtype=K.dtype, device=K.device))
        rays = pixel_rays(points_image.detach(), K.detach())
        sane = usable_coordinates(points_image) & usable_coordinates(points_model) & usable_coordinates(rays)
        valid = sane if valid is None else sane & valid.bool()
        points_image = points_image.masked_fill(~valid.unsqueeze(-1), 0.0)
        points_model = points_model.masked_fill(~valid.unsqueeze(-1), 0.0)

        count = valid.sum(-1)
        usable = (count >= _SAMPLE) & invertible
        fixed = (points_image.detach(), points_model.detach(), K.detach())
        T, quality, determined = self._sample(*fixed, valid, usable)
        found = quality >= 0
        T = torch.where(found[:, None, None], T, _pose_in_front(fixed[1], valid))

        inliers, cost = select_inliers(T, points_image, points_model, K, valid, self.threshold, self.loss)
        # A problem takes part as long as its inliers change; below four there is nothing to polish on.
        active = found & (inliers.sum(-1) >= _SAMPLE)
        for _ in range(self.polish_rounds):
            if not bool(active.any()):
                break
            polished = polish_pnp(
                T,
                points_image,
                points_model,
                K,
                inliers & active.unsqueeze(-1),
                loss=self.loss,
                max_iterations=self.polish_iterations,
            ).T
            inliers_new, cost_new = select_inliers(
                polished, points_image, points_model, K, valid, self.threshold, self.loss
            )
            better = active & (inliers_new.sum(-1) >= _SAMPLE) & (cost_new <= cost)
            active = better & (inliers_new != inliers).any(-1)
            T = torch.where(better[:, None, None], polished, T)
            inliers = torch.where(better[:, None], inliers_new, inliers)
            cost = torch.where(better, cost_new, cost)

        inliers = inliers & found.unsqueeze(-1)
        num_inliers = inliers.sum(-1)
        status = torch.full_like(num_inliers, int(PnpStatus.OK))
        status = status.masked_fill(num_inliers < self.min_inliers, int(PnpStatus.TOO_FEW_INLIERS))
        status = status.masked_fill(~found, int(PnpStatus.BEHIND_CAMERA))
        status = status.masked_fill(~determined, int(PnpStatus.DEGENERATE))
        status = status.masked_fill(count < _SAMPLE, int(PnpStatus.TOO_FEW_CORRESPONDENCES))
        squared, _ = reprojection_errors(T, points_image, points_model, K)
        mean = torch.where(inliers, squared, torch.zeros_like(squared)).sum(-1) / num_inliers.clamp(min=1)
        # The clamp keeps the square root's derivative finite for data that fit exactly.
        rmse = mean.clamp(min=torch.finfo(mean.dtype).tiny).sqrt()
        rmse = rmse.masked_fill(num_inliers == 0, torch.inf)
        return PnpResult(T, inliers, num_inliers, status == int(PnpStatus.OK), status, rmse)

    def _sample(
        self, points_image: Tensor, points_model: Tensor, K: Tensor, valid: Tensor, usable: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Best poses (B, 4, 4), their qualities (B,), −1 where there is none, and whether any sample determined
        a pose (B,)."""
        batch, total = points_image.shape[0], len(self.draws)
        rays = pixel_rays(points_image, K)
        count = valid.sum(-1)
        # Valid correspondences first, so that a rank among the valid ones becomes an index.
        order = torch.argsort((~valid).to(torch.uint8), dim=-1, stable=True)
        best_T = torch.eye(4, dtype=K.dtype, device=K.device).repeat(batch, 1, 1)
        best_quality = K.new_full((batch,), -1.0)
        determined = torch.zeros_like(usable)
        problems = usable.nonzero().squeeze(-1)
        for first in range(0, total, self.chunk):
            if problems.numel() == 0:
                break
            ranks = distinct_ranks(self.draws[first : first + self.chunk], count[problems])
            index = torch.take_along_dim(order[problems], ranks.flatten(1), dim=1).unsqueeze(-1)
            pixels, model = points_image[problems], points_model[problems]
            samples = ranks.shape[:2]
            solution = solve_epnp_minimal(
                torch.take_along_dim(rays[problems], index, dim=1).reshape(-1, _SAMPLE, 3),
                torch.take_along_dim(model, index, dim=1).reshape(-1, _SAMPLE, 3),
            )
            T = solution.T_camera_from_model.unflatten(0, samples)
            solved = solution.valid.unflatten(0, samples)
            quality = score_poses(T, pixels, model, K[problems], valid[problems], self.threshold)
            quality = quality.masked_fill(~solved, -1.0)
            # The first of equally good samples, on every device.
            top = quality.amax(-1, keepdim=True)
            position = torch.arange(samples[1], device=quality.device).expand_as(quality)
            position = position.masked_fill(quality < top, samples[1]).amin(-1)
            T = torch.take_along_dim(T, position[:, None, None, None], dim=1).squeeze(1)
            improved = top.squeeze(-1) > best_quality[problems]
            best_T[problems] = torch.where(improved[:, None, None], T, best_T[problems])
            best_quality[problems] = torch.where(improved, top.squeeze(-1), best_quality[problems])
            determined[problems] |= (~solution.degenerate).unflatten(0, samples).any(-1)
            if self.confidence is not None:
                drawn = first + samples[1]
                ratio = best_quality[problems].clamp(min=0.0).floor() / count[problems]
                missed = drawn * torch.log1p(-ratio.clamp(max=1.0 - 1e-6).pow(_SAMPLE))
                problems = problems[missed > math.log(1.0 - self.confidence)]
        return best_T, best_quality, determined


def distinct_ranks(draws: Tensor, count: Tensor) -> Tensor:
    """Turn integers into distinct ranks below each problem's count, by exact integer arithmetic.

    Args:
        draws: (I, s) int64 in [0, 2³¹).
        count: (B,) int64, at least s and below 2³².

    Returns:
        (B, I, s) int64 ranks, distinct along the last dimension and uniform over ordered selections.
    """
    picked: list[Tensor] = []
    for k in range(draws.shape[1]):
        rank = (draws[:, k] * (count[:, None] - k)) >> 31
        # Skip the ranks already taken, in ascending order.
        for taken in torch.stack(picked, dim=-1).sort(dim=-1).values.unbind(-1) if picked else ():
            rank = rank + (rank >= taken).to(rank.dtype)
        picked.append(rank)
    return torch.stack(picked, dim=-1)


def _pose_in_front(points_model: Tensor, valid: Tensor) -> Tensor:
    """Identity rotation with the whole object in front of the camera: the finite stand-in for no pose."""
    reach = torch.linalg.vector_norm(points_model, dim=-1).masked_fill(~valid, 0.0).sum(-1)
    depth = 1.0 + 2.0 * reach
    t = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], dim=-1)
    R = torch.eye(3, dtype=t.dtype, device=t.device).expand(*t.shape[:-1], 3, 3)
    return make_transform(R, t)

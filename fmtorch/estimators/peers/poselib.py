"""PoseLib's LO-RANSAC, with and without one unknown focal length (extra `peers`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmtorch.estimators.peers.pairwise import Pair, PairwiseEstimator, Solution, peer, solution

LOSSES = ("trivial", "truncated", "huber", "cauchy", "truncated_cauchy", "truncated_le_zach")
"""The robust losses of its refinement."""


def poselib(
    *,
    threshold: float = 1.0,
    confidence: float = 0.9999,
    iterations: int = 10000,
    min_iterations: int = 1000,
    prosac: bool = False,
    loss: str | None = None,
    loss_scale: float | None = None,
    real_focal_check: bool = False,
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for fundamental matrices (Larsson 2020).

    Args:
        threshold: pixels, Sampson distance.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        min_iterations: samples at least, though not more than at most.
        prosac: draw samples from the best matches first.
        loss: of the non-linear refinement, one of `LOSSES`; PoseLib's own if not given.
        loss_scale: pixels; PoseLib's own, half the threshold, if not given.
        real_focal_check: reject samples whose models give an imaginary focal length for square pixels and central
            principal points.

    Returns:
        The estimator.

    Raises:
        ImportError: with a hint, where PoseLib is not installed.
        ValueError: for another loss, or where this version of PoseLib lacks an option.
    """
    library = peer("poselib", "PoseLib")
    options = _options(library, threshold, confidence, iterations, min_iterations, prosac, real_focal_check)
    refinement = _refinement(loss, loss_scale)

    def solve(pair: Pair) -> Solution:
        centres = [np.array([(w - 1) / 2, (h - 1) / 2]) * real_focal_check for h, w in (pair.size0, pair.size1)]
        F, info = library.estimate_fundamental(
            pair.x0 - centres[0], pair.x1 - centres[1], {**options, "seed": pair.seed}, refinement
        )
        to_centre = [np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]]) for x, y in centres]
        return solution(to_centre[1].T @ F @ to_centre[0], info["inliers"])

    return PairwiseEstimator("PoseLib", solve, best_first=prosac)


def poselib_shared_focal(
    *,
    threshold: float = 1.0,
    confidence: float = 0.9999,
    iterations: int = 10000,
    min_iterations: int = 1000,
    prosac: bool = False,
    loss: str | None = None,
    loss_scale: float | None = None,
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for two cameras of one unknown focal length, principal points central, square pixels.

    Pairs whose images differ in size get its fundamental matrix. Arguments, result and errors are those of `poselib`.
    """
    library = peer("poselib", "PoseLib")
    options = _options(library, threshold, confidence, iterations, min_iterations, prosac)
    refinement = _refinement(loss, loss_scale)

    def solve(pair: Pair) -> Solution:
        if pair.size0 != pair.size1:
            F, info = library.estimate_fundamental(pair.x0, pair.x1, {**options, "seed": pair.seed}, refinement)
            return solution(F, info["inliers"])
        h, w = pair.size0
        centre = np.array([(w - 1) / 2, (h - 1) / 2])
        found, info = library.estimate_shared_focal_relative_pose(
            pair.x0, pair.x1, centre, {**options, "seed": pair.seed}, refinement
        )
        focal, pose = found.camera1.params[0], found.pose
        if not (np.isfinite(focal) and focal > 0):
            return None, np.zeros(len(pair.x0), dtype=np.bool_)
        to_ray = np.array([[1 / focal, 0, -centre[0] / focal], [0, 1 / focal, -centre[1] / focal], [0, 0, 1]])
        F = to_ray.T @ np.cross(np.eye(3), np.asarray(pose.t)).T @ np.asarray(pose.R) @ to_ray
        return solution(F, info["inliers"])

    return PairwiseEstimator("PoseLib, shared focal length", solve, best_first=prosac)


def _options(
    library: Any,
    threshold: float,
    confidence: float,
    iterations: int,
    min_iterations: int,
    prosac: bool,
    real_focal_check: bool = False,
) -> dict[str, Any]:
    """PoseLib's options of RANSAC. Raises ValueError where its version lacks the check of focal lengths."""
    options = {
        "max_epipolar_error": threshold, "success_prob": confidence, "max_iterations": iterations,
        "min_iterations": min(min_iterations, iterations), "progressive_sampling": prosac,
    }  # fmt: skip
    if real_focal_check:
        if "real_focal_check" not in library.RansacOptions():
            raise ValueError("this version of PoseLib has no real_focal_check; 2.0.4 and later have it")
        options["real_focal_check"] = True
    return options


def _refinement(loss: str | None, scale: float | None) -> dict[str, Any]:
    """PoseLib's options of the non-linear refinement: what is given. Raises ValueError for a loss it does not know."""
    if loss is not None and loss not in LOSSES:
        raise ValueError(f"loss is {loss!r}; it must be one of: {', '.join(LOSSES)}")
    given = {"loss_type": loss and loss.upper(), "loss_scale": scale}
    return {name: value for name, value in given.items() if value is not None}

"""PoseLib's LO-RANSAC, with and without one unknown focal length (extra `peers`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmtorch.estimators.peers.pairwise import Pair, PairwiseEstimator, Solution, peer, solution


def poselib(
    *, threshold: float = 1.0, confidence: float = 0.9999, iterations: int = 10000, prosac: bool = False
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for fundamental matrices (Larsson 2020).

    Args:
        threshold: pixels, Sampson distance.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        prosac: draw samples from the best matches first.

    Returns:
        The estimator.

    Raises:
        ImportError: with a hint, where PoseLib is not installed.
    """
    library, options = peer("poselib", "PoseLib"), _poselib_options(threshold, confidence, iterations, prosac)

    def solve(pair: Pair) -> Solution:
        F, info = library.estimate_fundamental(pair.x0, pair.x1, {**options, "seed": pair.seed}, {})
        return solution(F, info["inliers"])

    return PairwiseEstimator("PoseLib", solve, best_first=prosac)


def poselib_shared_focal(
    *, threshold: float = 1.0, confidence: float = 0.9999, iterations: int = 10000, prosac: bool = False
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for two cameras of one unknown focal length, principal points central, square pixels.

    Pairs whose images differ in size get its fundamental matrix. Arguments, result and errors are those of `poselib`.
    """
    library, options = peer("poselib", "PoseLib"), _poselib_options(threshold, confidence, iterations, prosac)

    def solve(pair: Pair) -> Solution:
        if pair.size0 != pair.size1:
            F, info = library.estimate_fundamental(pair.x0, pair.x1, {**options, "seed": pair.seed}, {})
            return solution(F, info["inliers"])
        h, w = pair.size0
        centre = np.array([(w - 1) / 2, (h - 1) / 2])
        found, info = library.estimate_shared_focal_relative_pose(
            pair.x0, pair.x1, centre, {**options, "seed": pair.seed}, {}
        )
        focal, pose = found.camera1.params[0], found.pose
        if not (np.isfinite(focal) and focal > 0):
            return None, np.zeros(len(pair.x0), dtype=np.bool_)
        to_ray = np.array([[1 / focal, 0, -centre[0] / focal], [0, 1 / focal, -centre[1] / focal], [0, 0, 1]])
        F = to_ray.T @ np.cross(np.eye(3), np.asarray(pose.t)).T @ np.asarray(pose.R) @ to_ray
        return solution(F, info["inliers"])

    return PairwiseEstimator("PoseLib, shared focal length", solve, best_first=prosac)


def _poselib_options(threshold: float, confidence: float, iterations: int, prosac: bool) -> dict[str, Any]:
    return {
        "max_epipolar_error": threshold, "success_prob": confidence,
        "max_iterations": iterations, "min_iterations": min(1000, iterations), "progressive_sampling": prosac,
    }  # fmt: skip

"""PoseLib's LO-RANSAC, with and without one unknown focal length (extra `peers`)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.estimators.external.pairwise import (
    Confidence,
    Iterations,
    Pair,
    PairwiseEstimator,
    Posed,
    Solution,
    computed_by,
    fundamental_of_pose,
    peer,
    solution,
)

LOSSES = ("trivial", "truncated", "huber", "cauchy", "truncated_cauchy", "truncated_le_zach")
"""The robust losses of its refinement."""


@computed_by("poselib")
def poselib(
    *,
    threshold: float = 1.0,
    confidence: Confidence = 0.9999,
    iterations: Iterations = 10000,
    min_iterations: int = 1000,
    prosac: bool = False,
    loss: str | None = None,
    loss_scale: float | None = None,
    real_focal_check: bool = False,
    shared_focal: bool = False,
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for fundamental matrices, or for two cameras of one unknown focal length (Larsson 2020).

    Where both focal lengths are exactly known (`find_essential`, `cameras=known`) it estimates a relative pose.

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
        shared_focal: estimate a relative pose and one focal length, for square pixels and central principal points.
            Pairs whose images differ in size get a fundamental matrix all the same.

    Returns:
        The estimator.

    Raises:
        ImportError: with a hint, where PoseLib is not installed.
        ValueError: for another loss, for both of the last two options, or where this version of PoseLib lacks one.
    """
    if real_focal_check and shared_focal:
        raise ValueError("real_focal_check is of fundamental matrices alone: leave it out, or shared_focal")
    library = peer("poselib", "PoseLib")
    options = {
        "max_epipolar_error": threshold, "success_prob": confidence, "max_iterations": iterations,
        "min_iterations": min(min_iterations, iterations), "progressive_sampling": prosac,
    }  # fmt: skip
    if real_focal_check:
        if "real_focal_check" not in library.RansacOptions():
            raise ValueError("this version of PoseLib has no real_focal_check; 2.0.4 and later have it")
        options["real_focal_check"] = True
    refinement = _refinement(loss, loss_scale)

    def solve(pair: Pair) -> Solution:
        seeded = {**options, "seed": pair.seed}
        if pair.exact is not None:
            return _relative_pose(library, pair, seeded, refinement)
        if shared_focal and pair.size0 == pair.size1:
            return _shared_focal(library, pair, seeded, refinement)
        centres = [_centre(size) * real_focal_check for size in (pair.size0, pair.size1)]
        F, info = library.estimate_fundamental(pair.x0 - centres[0], pair.x1 - centres[1], seeded, refinement)
        to_centre = [np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]]) for x, y in centres]
        return solution(to_centre[1].T @ F @ to_centre[0], info["inliers"])

    name = "PoseLib, shared focal length" if shared_focal else "PoseLib"
    return PairwiseEstimator(name, solve, best_first=prosac)


def _relative_pose(library: Any, pair: Pair, options: dict[str, Any], refinement: dict[str, Any]) -> Solution:
    """The relative pose of two calibrated cameras; their lenses have no distortion."""
    assert pair.exact is not None
    cameras = [
        {"model": "PINHOLE", "width": w, "height": h, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
        for K, (h, w) in zip(pair.exact, (pair.size0, pair.size1), strict=True)
    ]
    pose, info = library.estimate_relative_pose(pair.x0, pair.x1, *cameras, options, refinement)
    R, t = np.asarray(pose.R, np.float64), np.asarray(pose.t, np.float64)
    inliers = np.asarray(info["inliers"], np.bool_)
    return Posed(fundamental_of_pose(*pair.exact, R, t), inliers, None, R, t)


def _shared_focal(library: Any, pair: Pair, options: dict[str, Any], refinement: dict[str, Any]) -> Solution:
    """The fundamental matrix of the relative pose and the one focal length of two images of one size."""
    centre = _centre(pair.size0)
    image_pair, info = library.estimate_shared_focal_relative_pose(pair.x0, pair.x1, centre, options, refinement)
    focal, pose = image_pair.camera1.params[0], image_pair.pose
    if not (np.isfinite(focal) and focal > 0):
        return None, np.zeros(len(pair.x0), dtype=np.bool_)
    to_ray = np.array([[1 / focal, 0, -centre[0] / focal], [0, 1 / focal, -centre[1] / focal], [0, 0, 1]])
    F = to_ray.T @ np.cross(np.eye(3), np.asarray(pose.t)).T @ np.asarray(pose.R) @ to_ray
    return solution(F, info["inliers"])


def _centre(size: tuple[int, int]) -> NDArray[np.float64]:
    """The middle (x, y) of an image of a size (h, w), in pixels."""
    return (np.array(size[::-1], np.float64) - 1) / 2


def _refinement(loss: str | None, scale: float | None) -> dict[str, Any]:
    """PoseLib's options of the non-linear refinement: what is given. Raises ValueError for a loss it does not know."""
    if loss is not None and loss not in LOSSES:
        raise ValueError(f"loss is {loss!r}; it must be one of: {', '.join(LOSSES)}")
    given = {"loss_type": loss and loss.upper(), "loss_scale": scale}
    return {name: value for name, value in given.items() if value is not None}

"""fastpose's LO-RANSAC, compiled by numba: fundamental matrices, homographies, poses, focal lengths (extra `peers`)."""

from typing import Any

import numpy as np

from fmtorch.estimators.external.pairwise import (
    Confidence,
    Iterations,
    Pair,
    PairwiseEstimator,
    Points,
    Posed,
    Solution,
    computed_by,
    fundamental_of_pose,
    peer,
    solution,
)

FOCALS = ("shared", "varying")
MODELS = ("fundamental", "homography")


@computed_by("fastpose")
def fastpose(
    *,
    threshold: float = 1.0,
    confidence: Confidence = 0.9999,
    iterations: Iterations = 10000,
    min_iterations: int = 1000,
    model: str = "fundamental",
    focal: str | None = None,
) -> PairwiseEstimator:
    """fastpose's LO-RANSAC, whose kernels numba compiles at the first call.

    Where both focal lengths are exactly known (`find_essential`, `cameras=known`) it estimates a relative pose, and
    where cameras with unknown focal lengths are asked for, these with the pose.

    Args:
        threshold: pixels; Sampson distance, for homographies the root mean square of both transfer errors.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        min_iterations: samples at least, though not more than at most.
        model: fundamental or homography.
        focal: shared or varying: estimate a relative pose with one unknown focal length or two, for square pixels and
            central principal points, even where no cameras are asked for.

    Returns:
        The estimator.

    Raises:
        ImportError: with a hint, where fastpose is not installed.
        ValueError: for another model or `focal`, or for both.
    """
    if model not in MODELS or focal not in (None, *FOCALS):
        raise ValueError(f"model is {model!r} and focal {focal!r}; they must be of {MODELS} and {(None, *FOCALS)}")
    if model == "homography" and focal is not None:
        raise ValueError(f"focal={focal} is of fundamental matrices; leave it out, or model=homography")
    library = peer("fastpose", "fastpose").estimators
    options = {"iterations": iterations, "min_iterations": min(min_iterations, iterations), "success_prob": confidence}

    def solve(pair: Pair) -> Solution:
        own: dict[str, Any] = {**options, "max_error": threshold, "seed": pair.seed % 2**32}
        if model == "homography":
            result, info = library.estimate_homography(pair.x0, pair.x1, **own)
            return solution(result["H"], info["inliers"])
        if pair.exact is not None:
            result, info = library.estimate_relative_pose(pair.x0, pair.x1, *pair.exact, **own)
            return _posed(result, info, *pair.exact)
        kind = focal or (("varying", "shared")[pair.shared_focal] if pair.calibrations == (None, None) else None)
        if kind is not None:
            call = getattr(library, f"estimate_relative_pose_with_{kind}_focal{'s' * (kind == 'varying')}")
            centres = [(np.array(size[::-1], np.float64) - 1) / 2 for size in (pair.size0, pair.size1)]
            result, info = call(pair.x0, pair.x1, *centres, **own)
            names = ("f", "f") if kind == "shared" else ("f1", "f2")
            K0, K1 = (
                np.array([[result[name], 0, x], [0, result[name], y], [0, 0, 1]])
                for name, (x, y) in zip(names, centres, strict=True)
            )
            return _posed(result, info, K0, K1, np.array([result[name] for name in names]))
        result, info = library.estimate_fundamental(pair.x0, pair.x1, **own)
        return solution(result["F"], info["inliers"])

    return PairwiseEstimator("fastpose", solve, model=model)


def _posed(result: dict[str, Any], info: dict[str, Any], K0: Points, K1: Points, focals: Points | None = None) -> Posed:
    """A relative pose with F of its cameras; none where there are no inliers."""
    inliers = np.asarray(info["inliers"], np.bool_)
    F = fundamental_of_pose(K0, K1, result["R"], result["t"]) if info["num_inliers"] else None
    return Posed(F, inliers, focals, result["R"], result["t"])

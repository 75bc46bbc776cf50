"""OpenCV's robust estimators of fundamental matrices."""

import cv2
import numpy as np

from fmtorch.estimators.external.pairwise import Confidence, Iterations, Pair, PairwiseEstimator, Solution


def opencv(
    *, method: str, threshold: float = 1.0, confidence: Confidence = 0.999, iterations: Iterations = 2000
) -> PairwiseEstimator:
    """`cv2.findFundamentalMat` with one of its robust methods.

    USAC_PROSAC gets the matches best first, as it expects.

    Args:
        method: name of OpenCV's constant in any case, ransac, lmeds or usac_*; FM_RANSAC and FM_LMEDS as well.
        threshold: pixels, point to epipolar line (ransac) or Sampson distance (usac_*).
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.

    Returns:
        The estimator.

    Raises:
        ValueError: for a name that is no such constant.
    """
    name = method.upper()
    name = f"FM_{name}" if name in ("RANSAC", "LMEDS") else name
    code = getattr(cv2, name, None)
    if code is None or not name.startswith(("FM_", "USAC_")):
        raise ValueError(f"method is {method!r}; it must be ransac, lmeds, or one of cv2's constants USAC_* or FM_*")

    def solve(pair: Pair) -> Solution:
        F, mask = cv2.findFundamentalMat(pair.x0, pair.x1, int(code), threshold, confidence, iterations)
        if F is None or mask is None:  # a minimal set may also give several solutions, stacked
            return None, np.zeros(len(pair.x0), dtype=np.bool_)
        return F.astype(np.float64), mask.ravel().astype(np.bool_)

    return PairwiseEstimator(f"OpenCV {name}", solve, best_first=name == "USAC_PROSAC")

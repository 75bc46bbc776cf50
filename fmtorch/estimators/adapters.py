"""Other libraries' robust estimators behind the same call, one pair at a time: OpenCV, PoseLib (extra `peers`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.estimators.problem import usable
from fmtorch.types import Correspondences, Estimate

Points = NDArray[np.float64]
Solution = tuple[Points | None, NDArray[np.bool_]]

LEAST_MATCHES = 8


class PairwiseEstimator:
    """Runs a function (x0, x1, seed) -> (F or None, inliers) on each pair's live matches, best first if asked."""

    def __init__(self, name: str, solve: Callable[[Points, Points, int], Solution], sort_by_quality: bool) -> None:
        self.name, self._solve, self._sort = name, solve, sort_by_quality

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate each pair in turn; a pair without a solution is `ok=False` with a reason."""
        b, n = c.mask.shape
        F = torch.zeros(b, 3, 3, dtype=torch.float64)
        inliers = torch.zeros(b, n, dtype=torch.bool)
        reasons = [""] * b
        live = usable(c).cpu()
        for i in range(b):
            index = live[i].nonzero()[:, 0]
            if self._sort and c.quality is not None:
                index = index[c.quality[i].detach().cpu()[index].argsort(stable=True)]
            if len(index) < LEAST_MATCHES:
                reasons[i] = f"{len(index)} matches; at least {LEAST_MATCHES} are needed"
                continue
            x0, x1 = (x[i].detach().cpu()[index].to(torch.float64).numpy() for x in (c.x0, c.x1))
            estimate, inside = self._solve(x0, x1, seed)
            if estimate is None or not np.isfinite(estimate).all() or not np.any(estimate):
                reasons[i] = f"{self.name} found no fundamental matrix"
                continue
            F[i] = torch.from_numpy(estimate / np.linalg.norm(estimate))
            inliers[i, index[torch.from_numpy(inside)]] = True
        ok = torch.tensor([not reason for reason in reasons])
        draws = torch.zeros(b, dtype=torch.int64)  # not reported by these libraries
        return Estimate(F, inliers, ok, tuple(reasons), draws).to(c.mask.device)


def opencv(
    *, method: str, threshold: float = 1.0, confidence: float = 0.999, iterations: int = 2000
) -> PairwiseEstimator:
    """`cv2.findFundamentalMat` with one of its robust methods.

    method: name of OpenCV's constant, e.g. FM_RANSAC, FM_LMEDS, USAC_MAGSAC. threshold: pixels, point to epipolar line
    (FM_RANSAC) or Sampson distance (USAC_*). USAC_PROSAC gets the matches best quality first, as it expects.
    """
    code = getattr(cv2, method, None)
    if code is None or not method.startswith(("FM_", "USAC_")):
        raise ValueError(f"method is {method!r}; it must name one of cv2's constants FM_* or USAC_*")

    def solve(x0: Points, x1: Points, seed: int) -> Solution:
        F, mask = cv2.findFundamentalMat(x0, x1, int(code), threshold, confidence, iterations)
        if F is None or F.shape != (3, 3) or mask is None:  # several or no solutions of a minimal set
            return None, np.zeros(len(x0), dtype=np.bool_)
        return F.astype(np.float64), mask.ravel().astype(np.bool_)

    return PairwiseEstimator(f"OpenCV {method}", solve, sort_by_quality=method == "USAC_PROSAC")


def poselib(
    *, threshold: float = 1.0, confidence: float = 0.9999, iterations: int = 10000, prosac: bool = False
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for fundamental matrices (Larsson 2020). threshold: pixels, Sampson distance.

    prosac: draw samples from the best matches first. Raises ImportError with a hint where PoseLib is not installed.
    """
    try:
        import poselib as library
    except ImportError as error:
        raise ImportError("PoseLib is not installed: pip install 'fmtorch[peers]'") from error
    options: dict[str, Any] = {
        "max_epipolar_error": threshold, "success_prob": confidence,
        "max_iterations": iterations, "min_iterations": min(1000, iterations), "progressive_sampling": prosac,
    }  # fmt: skip

    def solve(x0: Points, x1: Points, seed: int) -> Solution:
        F, info = library.estimate_fundamental(x0, x1, {**options, "seed": seed}, {})
        return np.asarray(F, dtype=np.float64), np.asarray(info["inliers"], dtype=np.bool_)

    return PairwiseEstimator("PoseLib", solve, sort_by_quality=prosac)

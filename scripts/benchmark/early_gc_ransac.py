"""GC-RANSAC as the software computed it that its authors had published when the paper appeared: what is peculiar to it.

Written anew from what that software does. Coordinates are not normalised and numbers have single precision throughout,
in samples of seven matches, in local optimisation and in the last fit to all inliers; the rank of that fit is not
reduced. Residuals are the mean of the two distances to the epipolar lines. Not here: the spatial term of its labelling.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.estimators.external.pairwise import Pair, PairwiseEstimator, Solution

Single = NDArray[np.float32]
MINIMAL, LOCAL_SAMPLE, LOCAL_SAMPLES = 7, 49, 20  # matches of a sample, those of local optimisation, how many of these
BEFORE_LOCAL = 50  # samples before the first local optimisation
ORIGIN = 1.0  # coordinates of the first pixel's centre, as MATLAB counts


@dataclasses.dataclass
class EarlyGCRansac:
    """A match counts where its residual is below `within`, in pixels.

    iterations: samples at most. confidence: of having drawn a sample without an outlier, at which the search ends.
    normalized: make the last fit by OpenCV's normalised 8-point algorithm instead, in double precision.
    """

    within: float
    confidence: float
    iterations: int = 2000
    normalized: bool = False

    def estimator(self) -> PairwiseEstimator:
        """As an estimator of batches."""
        return PairwiseEstimator("GC-RANSAC, early", self.solve)

    def solve(self, pair: Pair) -> Solution:
        """The last fit, and the inliers of the model before it."""
        points = (pair.joined + ORIGIN).astype(np.float32)
        inside = self._search(points, np.random.default_rng(pair.seed))
        if inside.sum() <= MINIMAL:
            return None, inside
        if self.normalized:
            fit, _ = cv2.findFundamentalMat(pair.x0[inside], pair.x1[inside], cv2.FM_8POINT)
            return np.asarray(fit, np.float64), inside
        shift = np.array([[1, 0, ORIGIN], [0, 1, ORIGIN], [0, 0, 1]])
        F = shift.T @ eight_point(points[inside]).astype(np.float64) @ shift
        return F, inside

    def _search(self, points: Single, random: np.random.Generator) -> NDArray[np.bool_]:
        """The inliers of the best model."""
        best, optimized, end, draw = np.zeros(len(points), bool), False, self.iterations, 0
        while draw < end:
            draw += 1
            risen = False
            for F in seven_point(points[random.choice(len(points), MINIMAL, replace=False)]):
                inside = residuals(F, points) < self.within
                if inside.sum() > best.sum():
                    best, risen = inside, True
            if draw > BEFORE_LOCAL and (risen or not optimized) and best.sum() > MINIMAL:
                best, optimized = self._optimized(best, points, random), True
            end = min(end, self._enough(best))
        return best if optimized or best.sum() <= MINIMAL else self._optimized(best, points, random)

    def _optimized(self, best: NDArray[np.bool_], points: Single, random: np.random.Generator) -> NDArray[np.bool_]:
        """Local optimisation: fits to samples of the inliers, again while one of them has more."""
        rising = True
        while rising:
            rising, inliers = False, np.flatnonzero(best)
            for _ in range(LOCAL_SAMPLES):
                subset = random.choice(inliers, min(LOCAL_SAMPLE, len(inliers)), replace=False)
                inside = residuals(eight_point(points[subset]), points) < self.within
                if inside.sum() > best.sum():
                    best, rising = inside, True
        return best

    def _enough(self, inside: NDArray[np.bool_]) -> int:
        """How many samples make one without outliers likely enough."""
        good = float(inside.mean()) ** MINIMAL
        if good <= 0:
            return self.iterations
        return 1 if good >= 1 else int(np.log(1 - self.confidence) / np.log1p(-good)) + 1


def residuals(F: Single, points: Single) -> Single:
    """Mean of the two distances to the epipolar lines, px, (n,)."""
    ones = np.ones((len(points), 1), np.float32)
    x0, x1 = np.hstack([points[:, :2], ones]), np.hstack([points[:, 2:], ones])
    line1, line0 = x0 @ F.T, x1 @ F
    with np.errstate(all="ignore"):
        per_length = 1 / np.hypot(*line0[:, :2].T) + 1 / np.hypot(*line1[:, :2].T)
        distances: Single = np.abs((line1 * x1).sum(1)) * per_length / 2
    return distances


def eight_point(points: Single) -> Single:
    """The 8-point algorithm without normalisation and with full rank."""
    matrix: Single = _eigenvectors(points)[8].reshape(3, 3)
    return matrix


def seven_point(points: Single) -> list[Single]:
    """The models through seven matches, without normalisation."""
    *_, a, b = _eigenvectors(points)
    first, second = (a - b).reshape(3, 3), b.reshape(3, 3)
    at = np.array([0.0, 1.0, -1.0, 2.0])
    values = np.linalg.det(at[:, None, None] * first.astype(np.float64) + second)
    count, roots = cv2.solveCubic(np.linalg.solve(np.vander(at), values).astype(np.float32))
    return [root * first + second for root in roots.ravel()[: max(count, 0)]]


def _eigenvectors(points: Single) -> Single:
    """Those of A^T A, (9, 9), rows by falling eigenvalue; A has a row x1 y0 ... a match."""
    x0, y0, x1, y1 = points.T
    ones = np.ones_like(x0)
    A = np.stack([x1 * x0, x1 * y0, x1, y1 * x0, y1 * y0, y1, x0, y0, ones], 1)
    vectors: Single = np.asarray(cv2.eigen(A.T @ A)[2], np.float32)
    return vectors

"""Other libraries' robust estimators behind the same call, one pair at a time.

OpenCV and kornia are always there; PoseLib, MAGSAC++, GC-RANSAC and DEGENSAC by their authors are the extra `peers`.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.estimators.pairs import finite_matches, unfit_pairs
from fmtorch.estimators.support import lack_of_support, relative_rounding
from fmtorch.types import Correspondences, Estimate
from fmtorch.verdict import judged

Points = NDArray[np.float64]
Solution = tuple[Points | None, NDArray[np.bool_]]

LEAST_MATCHES = 8
MINIMAL_SAMPLE = 7  # inliers below which a model is none

PEERS = {
    "poselib": "poselib", "poselib_shared_focal": "poselib", "magsac_cpp": "pymagsac", "gc_ransac_cpp": "pygcransac",
    "degensac_cpp": "pydegensac",
}  # fmt: skip
"""The packages whose versions decide what the functions of these names compute."""

FAILURES = (cv2.error, RuntimeError, ValueError)  # how these libraries say that they cannot solve a pair
# The numbers of the samplers in the authors' bindings of MAGSAC++ and GC-RANSAC.
SAMPLERS = {"uniform": 0, "prosac": 1, "progressive_napsac": 2, "importance": 3, "adaptive": 4}


@dataclasses.dataclass(frozen=True)
class Pair:
    """A pair's live matches as these libraries take them: x0, x1 (N, 2) in pixels, likelihood (N,), sizes (h, w).

    likelihood: the prior where there is one, else 1 - quality, else 1; matches are in its descending order if asked.
    """

    x0: Points
    x1: Points
    likelihood: NDArray[np.float64]
    size0: tuple[int, int]
    size1: tuple[int, int]
    seed: int

    @property
    def joined(self) -> Points:
        """x0, y0, x1, y1 a row."""
        return np.ascontiguousarray(np.hstack([self.x0, self.x1]))


class PairwiseEstimator:
    """Runs a function of a `Pair` -> (F or None, inliers) on each pair's live matches, best first if asked."""

    def __init__(self, name: str, solve: Callable[[Pair], Solution], best_first: bool = False) -> None:
        self.name, self._solve, self._best_first = name, solve, best_first

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate each pair in turn; a pair without a solution is `ok=False` with a reason.

        Raises ValueError where somebody asks for gradients, which no other library gives.
        """
        if c.requires_grad:
            raise ValueError(
                f"{self.name} passes no gradient on: give it matches that need none (`x0.detach()`), or take an "
                "estimator of this project"
            )
        b, n = c.mask.shape
        F = torch.zeros(b, 3, 3, dtype=torch.float64)
        inliers = torch.zeros(b, n, dtype=torch.bool)
        mask = finite_matches(c)
        _, reasons = unfit_pairs(c, mask, LEAST_MATCHES)
        mask = mask.cpu()
        for i in range(b):
            if reasons[i]:
                continue
            index = mask[i].nonzero()[:, 0]
            likelihood = _likelihood(c, i)[index]
            if self._best_first:
                order = likelihood.argsort(descending=True, stable=True)
                index, likelihood = index[order], likelihood[order]
            x0, x1 = (x[i].detach().cpu()[index].to(torch.float64).numpy() for x in (c.x0, c.x1))
            size0, size1 = _size(c.size0, x0, i), _size(c.size1, x1, i)
            try:
                estimate, inside = self._solve(Pair(x0, x1, likelihood.numpy(), size0, size1, seed))
            except FAILURES as failure:  # OpenCV's USAC asserts what some matches do not fulfil
                reasons[i] = f"{self.name} failed: {' '.join(str(failure).split())}"
                continue
            if estimate is None or estimate.shape != (3, 3) or not np.isfinite(estimate).all() or not np.any(estimate):
                reasons[i] = f"{self.name} found no fundamental matrix"
                continue
            lack = _lack_of_support(x0, x1, inside, relative_rounding(c.x0.dtype))
            if lack:
                reasons[i] = lack
                continue
            F[i] = torch.from_numpy(estimate / np.linalg.norm(estimate))
            inliers[i, index[torch.from_numpy(inside)]] = True
        ok = torch.tensor([not reason for reason in reasons], dtype=torch.bool)
        draws = torch.zeros(b, dtype=torch.int64)  # not reported by these libraries
        return judged(Estimate(F, inliers, ok, tuple(reasons), draws).to(c.mask.device), c)


def opencv(
    *, method: str, threshold: float = 1.0, confidence: float = 0.999, iterations: int = 2000
) -> PairwiseEstimator:
    """`cv2.findFundamentalMat` with one of its robust methods.

    method: name of OpenCV's constant, e.g. FM_RANSAC, FM_LMEDS, USAC_MAGSAC. threshold: pixels, point to epipolar line
    (FM_RANSAC) or Sampson distance (USAC_*). USAC_PROSAC gets the matches best first, as it expects.
    """
    code = getattr(cv2, method, None)
    if code is None or not method.startswith(("FM_", "USAC_")):
        raise ValueError(f"method is {method!r}; it must name one of cv2's constants FM_* or USAC_*")

    def solve(pair: Pair) -> Solution:
        F, mask = cv2.findFundamentalMat(pair.x0, pair.x1, int(code), threshold, confidence, iterations)
        if F is None or mask is None:  # a minimal set may also give several solutions, stacked
            return None, np.zeros(len(pair.x0), dtype=np.bool_)
        return F.astype(np.float64), mask.ravel().astype(np.bool_)

    return PairwiseEstimator(f"OpenCV {method}", solve, best_first=method == "USAC_PROSAC")


def kornia_ransac(
    *, threshold: float = 1.0, confidence: float = 0.9999, batch_size: int = 2048, rounds: int = 10, prosac: bool = True
) -> PairwiseEstimator:
    """`kornia.geometry.RANSAC` with MSAC scores. threshold: pixels; rounds: batches of `batch_size` samples at most."""

    def solve(pair: Pair) -> Solution:
        estimator = kornia.geometry.RANSAC(
            "fundamental", inl_th=threshold, batch_size=batch_size, max_iter=rounds, confidence=confidence,
            prosac_sampling=prosac, seed=pair.seed,
        )  # fmt: skip
        x0, x1, weights = (torch.from_numpy(a).to(torch.float32) for a in (pair.x0, pair.x1, pair.likelihood))
        F, mask = estimator(x0, x1, weights)
        return F.to(torch.float64).numpy(), mask.numpy().astype(np.bool_)

    return PairwiseEstimator("kornia", solve, best_first=prosac)


def poselib(
    *, threshold: float = 1.0, confidence: float = 0.9999, iterations: int = 10000, prosac: bool = False
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for fundamental matrices (Larsson 2020). threshold: pixels, Sampson distance.

    prosac: draw samples from the best matches first. Raises ImportError with a hint where PoseLib is not installed.
    """
    library, options = _peer("poselib", "PoseLib"), _poselib_options(threshold, confidence, iterations, prosac)

    def solve(pair: Pair) -> Solution:
        F, info = library.estimate_fundamental(pair.x0, pair.x1, {**options, "seed": pair.seed}, {})
        return _solution(F, info["inliers"])

    return PairwiseEstimator("PoseLib", solve, best_first=prosac)


def poselib_shared_focal(
    *, threshold: float = 1.0, confidence: float = 0.9999, iterations: int = 10000, prosac: bool = False
) -> PairwiseEstimator:
    """PoseLib's LO-RANSAC for two cameras of one unknown focal length, principal points central, square pixels.

    Pairs whose images differ in size get its fundamental matrix. Options as of `poselib`. Raises ImportError with a
    hint where PoseLib is not installed.
    """
    library, options = _peer("poselib", "PoseLib"), _poselib_options(threshold, confidence, iterations, prosac)

    def solve(pair: Pair) -> Solution:
        if pair.size0 != pair.size1:
            F, info = library.estimate_fundamental(pair.x0, pair.x1, {**options, "seed": pair.seed}, {})
            return _solution(F, info["inliers"])
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
        return _solution(F, info["inliers"])

    return PairwiseEstimator("PoseLib, shared focal length", solve, best_first=prosac)


def _poselib_options(threshold: float, confidence: float, iterations: int, prosac: bool) -> dict[str, Any]:
    return {
        "max_epipolar_error": threshold, "success_prob": confidence,
        "max_iterations": iterations, "min_iterations": min(1000, iterations), "progressive_sampling": prosac,
    }  # fmt: skip


def magsac_cpp(
    *, threshold: float = 3.0, confidence: float = 0.9999, iterations: int = 10000, sampler: str = "adaptive"
) -> PairwiseEstimator:
    """MAGSAC++ by its authors (Barath et al., CVPR 2020), which draws its own random seed.

    threshold: pixels, the largest noise scale. sampler: one of `SAMPLERS`. Raises ImportError without `pymagsac`.
    """
    library, number = _peer("pymagsac", "MAGSAC++"), SAMPLERS[sampler]

    def solve(pair: Pair) -> Solution:
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if number > 2 else []
        F, inside = library.findFundamentalMatrix(
            pair.joined, w0, h0, w1, h1, weights, number, True, threshold, confidence, 50, iterations, 5
        )
        return _solution(F, inside)

    return PairwiseEstimator("MAGSAC++", solve, best_first=number in (1, 2))


def gc_ransac_cpp(
    *,
    threshold: float = 1.0,
    confidence: float = 0.9999,
    iterations: int = 10000,
    sampler: str = "prosac",
    coherence: float = 0.975,
) -> PairwiseEstimator:
    """GC-RANSAC by its authors (Barath & Matas, CVPR 2018), which draws its own random seed.

    threshold: pixels. coherence: weight of the spatial term. Raises ImportError without `pygcransac`.
    """
    library, number = _peer("pygcransac", "GC-RANSAC"), SAMPLERS[sampler]

    def solve(pair: Pair) -> Solution:
        weights = pair.likelihood.tolist() if number > 2 else []
        F, inside = library.findFundamentalMatrix(
            pair.joined, *pair.size0, *pair.size1, weights, threshold, confidence, coherence, iterations, 50, True,
            1e-5, number,
        )  # fmt: skip
        return _solution(F, inside)

    return PairwiseEstimator("GC-RANSAC", solve, best_first=number in (1, 2))


def degensac_cpp(*, threshold: float = 0.5, confidence: float = 0.9999, iterations: int = 10000) -> PairwiseEstimator:
    """DEGENSAC by its authors (Chum et al., CVPR 2005; Mishkin et al., 2015). threshold: pixels, Sampson distance.

    Raises ImportError without `pydegensac`.
    """
    library = _peer("pydegensac", "DEGENSAC")

    def solve(pair: Pair) -> Solution:
        F, inside = library.findFundamentalMatrix(
            pair.x0, pair.x1, threshold, confidence, iterations, seed=pair.seed + 1
        )
        return _solution(F, inside)

    return PairwiseEstimator("DEGENSAC", solve)


def _peer(module: str, name: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{name} ({module}) is not installed: pip install 'fmtorch[peers]'") from error


def _solution(F: Any, inliers: Any) -> Solution:
    return None if F is None else np.asarray(F, dtype=np.float64), np.asarray(inliers, dtype=np.bool_).ravel()


def _lack_of_support(x0: Points, x1: Points, inliers: NDArray[np.bool_], rounding: float) -> str:
    points = np.hstack([x0, x1])
    largest, points = np.abs(points).max(), points - points.min(0)
    unit = points.max() or 1.0
    scaled, inside = torch.from_numpy(points.T[:, None] / unit), torch.from_numpy(inliers[None])
    return lack_of_support(scaled, inside, MINIMAL_SAMPLE, torch.tensor([largest / unit * rounding]))[0]


def _likelihood(c: Correspondences, i: int) -> torch.Tensor:
    if c.prior is not None:
        value = c.prior[i]
    elif c.quality is not None:
        value = 1 - c.quality[i]
    else:
        value = torch.ones(c.mask.shape[1])
    return value.detach().cpu().to(torch.float64)


def _size(sizes: torch.Tensor | None, x: Points, i: int) -> tuple[int, int]:
    """The image's (h, w); where it is not known, that of the box of the points from the origin."""
    if sizes is not None:
        h, w = (math.ceil(v) for v in sizes[i].tolist())
        return h, w
    w, h = (int(v) + 1 for v in np.ceil(x.max(0, initial=0.0)))
    return h, w

"""OpenCV's, kornia's and the authors' own robust estimators (the latter in the extra `peers`)."""

from collections.abc import Mapping
from typing import TypeVar

import cv2
import numpy as np
import torch

from fmtorch.estimators.external.pairwise import (
    Confidence,
    Iterations,
    Pair,
    PairwiseEstimator,
    Solution,
    computed_by,
    peer,
    solution,
    within,
)


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


# kornia's RANSAC


def kornia_ransac(
    *,
    threshold: float = 1.0,
    confidence: Confidence = 0.9999,
    batch_size: int = 2048,
    rounds: int = 10,
    prosac: bool = True,
) -> PairwiseEstimator:
    """`kornia.geometry.RANSAC` with MSAC scores.

    Args:
        threshold: pixels.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        batch_size: samples that are drawn together.
        rounds: batches at most.
        prosac: draw samples from the best matches first.

    Returns:
        The estimator.
    """

    import kornia  # nobody else's estimator waits for it

    def solve(pair: Pair) -> Solution:
        estimator = kornia.geometry.RANSAC(
            "fundamental", inl_th=threshold, batch_size=batch_size, max_iter=rounds, confidence=confidence,
            prosac_sampling=prosac, seed=pair.seed,
        )  # fmt: skip
        x0, x1, weights = (torch.from_numpy(a).to(torch.float32) for a in (pair.x0, pair.x1, pair.likelihood))
        F, mask = estimator(x0, x1, weights)
        return F.to(torch.float64).numpy(), mask.numpy().astype(np.bool_)

    return PairwiseEstimator("kornia", solve, best_first=prosac)


# MAGSAC++, GC-RANSAC, DEGENSAC and SupeRANSAC as their authors published them (extra `peers`)

Part = TypeVar("Part", int, str)

# The numbers of the samplers in the authors' bindings of MAGSAC++ and GC-RANSAC.
MAX_SEED = 2**31 - 1  # of 32 bits, as DEGENSAC takes them
SAMPLERS = {"uniform": 0, "prosac": 1, "progressive_napsac": 2, "importance": 3, "adaptive": 4}
# The names of the parts in the binding of SupeRANSAC.
SUPERANSAC_SAMPLERS = {
    "uniform": "Uniform",
    "prosac": "PROSAC",
    "importance": "ImportanceSampler",
    "adaptive": "ARSampler",
}
SUPERANSAC_SCORES = {"ransac": "RANSAC", "msac": "MSAC", "magsac": "MAGSAC"}


@computed_by("pymagsac")
def magsac_cpp(
    *,
    threshold: float = 3.0,
    confidence: Confidence = 0.9999,
    iterations: Iterations = 10000,
    sampler: str = "adaptive",
) -> PairwiseEstimator:
    """MAGSAC++ by its authors (Barath et al., CVPR 2020), which draws its own random seed.

    Args:
        threshold: pixels, the largest noise scale.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        sampler: one of `SAMPLERS`.

    Returns:
        The estimator.

    Raises:
        ImportError: where `pymagsac` is not installed.
        ValueError: for another sampler.
    """
    number, library = _named("sampler", sampler, SAMPLERS), peer("pymagsac", "MAGSAC++")

    def solve(pair: Pair) -> Solution:
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if number > 2 else []
        F, inside = library.findFundamentalMatrix(
            pair.joined, w0, h0, w1, h1, weights, number, True, threshold, confidence, 50, iterations, 5
        )
        return solution(F, inside)

    return PairwiseEstimator("MAGSAC++", solve, best_first=number in (1, 2))


@computed_by("pygcransac")
def gc_ransac_cpp(
    *,
    threshold: float = 1.0,
    confidence: Confidence = 0.9999,
    iterations: Iterations = 10000,
    sampler: str = "prosac",
    coherence: float = 0.975,
) -> PairwiseEstimator:
    """GC-RANSAC by its authors (Barath & Matas, CVPR 2018), which draws its own random seed.

    Inliers are told from its F: the flags that its binding returns (pygcransac 0.1.1) are all set, or none.

    Args:
        threshold: pixels, Sampson distance.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        sampler: one of `SAMPLERS`.
        coherence: weight of the spatial term.

    Returns:
        The estimator.

    Raises:
        ImportError: where `pygcransac` is not installed.
        ValueError: for another sampler.
    """
    number, library = _named("sampler", sampler, SAMPLERS), peer("pygcransac", "GC-RANSAC")

    def solve(pair: Pair) -> Solution:
        weights = pair.likelihood.tolist() if number > 2 else []
        F, _ = library.findFundamentalMatrix(
            pair.joined, *pair.size0, *pair.size1, weights, threshold, confidence, coherence, iterations, 50, True,
            1e-5, number,
        )  # fmt: skip
        return solution(F, [] if F is None else within(F, pair, threshold))

    return PairwiseEstimator("GC-RANSAC", solve, best_first=number in (1, 2))


@computed_by("pydegensac")
def degensac_cpp(
    *, threshold: float = 0.5, confidence: Confidence = 0.9999, iterations: Iterations = 10000
) -> PairwiseEstimator:
    """DEGENSAC by its authors (Chum et al., CVPR 2005; Mishkin et al., 2015).

    Args:
        threshold: pixels, Sampson distance.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.

    Returns:
        The estimator.

    Raises:
        ImportError: where `pydegensac` is not installed.
    """
    library = peer("pydegensac", "DEGENSAC")

    def solve(pair: Pair) -> Solution:
        F, inside = library.findFundamentalMatrix(
            pair.x0, pair.x1, threshold, confidence, iterations, seed=pair.seed % (MAX_SEED - 1) + 1
        )
        return solution(F, inside)

    return PairwiseEstimator("DEGENSAC", solve)


@computed_by("pysuperansac")
def superansac_cpp(
    *,
    threshold: float = 1.5,
    confidence: Confidence = 0.9999,
    iterations: Iterations = 10000,
    sampler: str = "prosac",
    score: str = "magsac",
) -> PairwiseEstimator:
    """SupeRANSAC by its author (Barath, arXiv 2506.04803), with nested RANSAC and a final iterated least-squares fit.

    It takes no seed. Its graph cut and progressive NAPSAC are left out: they refuse negative coordinates.

    Args:
        threshold: pixels.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        sampler: one of `SUPERANSAC_SAMPLERS`.
        score: one of `SUPERANSAC_SCORES`.

    Returns:
        The estimator.

    Raises:
        ImportError: where `pysuperansac` is not installed.
        ValueError: for another sampler or score.
    """
    named = _named("sampler", sampler, SUPERANSAC_SAMPLERS), _named("score", score, SUPERANSAC_SCORES)
    library = peer("pysuperansac", "SupeRANSAC")

    def solve(pair: Pair) -> Solution:
        settings = (
            library.RANSACSettings()
        )  # each call divides the threshold of its settings by the scale of the points
        settings.sampler = getattr(library.SamplerType, named[0])
        settings.scoring = getattr(library.ScoringType, named[1])
        settings.inlier_threshold, settings.confidence = threshold, confidence
        settings.min_iterations, settings.max_iterations = min(1000, iterations), iterations
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if sampler in ("importance", "adaptive") else []
        F, indices, _, _ = library.estimateFundamentalMatrix(pair.joined, [w0, h0, w1, h1], weights, settings)
        inliers = np.zeros(len(pair.x0), dtype=np.bool_)
        inliers[indices] = True
        return solution(F, inliers)

    return PairwiseEstimator("SupeRANSAC", solve, best_first=sampler == "prosac")


def _named(option: str, name: str, choices: Mapping[str, Part]) -> Part:
    """What an option's value stands for; raises ValueError for a name that is not among its choices."""
    if name not in choices:
        raise ValueError(f"{option} is {name!r}; it must be one of: {', '.join(choices)}")
    return choices[name]

"""MAGSAC++, GC-RANSAC and DEGENSAC as their authors published them (extra `peers`)."""

from __future__ import annotations

from fmtorch.estimators.peers.pairwise import Pair, PairwiseEstimator, Solution, peer, solution, within

# The numbers of the samplers in the authors' bindings of MAGSAC++ and GC-RANSAC.
SAMPLERS = {"uniform": 0, "prosac": 1, "progressive_napsac": 2, "importance": 3, "adaptive": 4}


def magsac_cpp(
    *, threshold: float = 3.0, confidence: float = 0.9999, iterations: int = 10000, sampler: str = "adaptive"
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
    number, library = _sampler(sampler), peer("pymagsac", "MAGSAC++")

    def solve(pair: Pair) -> Solution:
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if number > 2 else []
        F, inside = library.findFundamentalMatrix(
            pair.joined, w0, h0, w1, h1, weights, number, True, threshold, confidence, 50, iterations, 5
        )
        return solution(F, inside)

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
    number, library = _sampler(sampler), peer("pygcransac", "GC-RANSAC")

    def solve(pair: Pair) -> Solution:
        weights = pair.likelihood.tolist() if number > 2 else []
        F, _ = library.findFundamentalMatrix(
            pair.joined, *pair.size0, *pair.size1, weights, threshold, confidence, coherence, iterations, 50, True,
            1e-5, number,
        )  # fmt: skip
        return solution(F, [] if F is None else within(F, pair, threshold))

    return PairwiseEstimator("GC-RANSAC", solve, best_first=number in (1, 2))


def degensac_cpp(*, threshold: float = 0.5, confidence: float = 0.9999, iterations: int = 10000) -> PairwiseEstimator:
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
            pair.x0, pair.x1, threshold, confidence, iterations, seed=pair.seed + 1
        )
        return solution(F, inside)

    return PairwiseEstimator("DEGENSAC", solve)


def _sampler(name: str) -> int:
    """The number of a sampler of `SAMPLERS`; raises ValueError for any other name."""
    if name not in SAMPLERS:
        raise ValueError(f"sampler is {name!r}; it must be one of: {', '.join(SAMPLERS)}")
    return SAMPLERS[name]

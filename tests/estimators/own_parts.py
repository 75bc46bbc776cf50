"""Parts as somebody else writes them."""

from typing import Any

import numpy as np

from fmtorch.estimators import F4x2, Pair, SummedGains, Uniform, kernel

Array = np.ndarray[Any, Any]


class Welsch(SummedGains):
    """exp(-r^2), r in thresholds (Dennis & Welsch 1978)."""

    def gain(self, squared: Array) -> Array:
        return np.exp(-squared)


class Squares(SummedGains):
    """The gain of MSAC; what is negative counts nothing."""

    def gain(self, squared: Array) -> Array:
        return 1 - squared


@kernel
def squares(squared: F4x2, out: F4x2) -> None:
    for k in range(len(squared)):
        for i in range(squared.shape[1]):
            out[k, i] = max(1 - squared[k, i], 0)


class CompiledSquares(SummedGains):
    gain_kernel = squares


class Same:
    """The built-in uniform sampler under another name."""

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        return Uniform().draw(pair, start, count, size)


class BestHalf:
    """Samples from the better half of the matches."""

    uses_prior = False

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        best = np.argsort(pair.ambiguity, kind="stable")[: max(size, pair.count // 2)]
        return best[different(pair, start, count, size, len(best))]


class AllAlike:
    """Samples from all matches, as the built-in uniform sampler draws them, in NumPy."""

    uses_prior = False

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        return different(pair, start, count, size, pair.count)


def different(pair: Pair, start: int, count: int, size: int, among: int) -> Array:
    """Different numbers below `among`, (size, count) int64."""
    left = among - np.arange(size)  # of which the next one is drawn
    index = (pair.uniform(start, count, size) * left).astype(np.int64).T
    for j in range(1, size):  # past those drawn before
        for drawn in np.sort(index[:j], axis=0):
            index[j] += index[j] >= drawn
    return index


class Within2Px:
    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        return squared_px <= 4.0


class Sampled:
    uses_prior = False

    def __init__(self, sample: Any) -> None:
        self.sample = sample

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Any:
        return self.sample(count, size) if callable(self.sample) else self.sample


class Scored:
    prior_weighted = False

    def __init__(self, scores: Any) -> None:
        self.scores = scores

    def __call__(self, F: Array, which: Array, pair: Pair) -> Any:
        return self.scores(which)

"""Parts as somebody else writes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmtorch.estimators import F4x2, Pair, SummedGains, kernel

Array = np.ndarray[Any, Any]


class Welsch(SummedGains):
    """exp(-r^2), r in thresholds (Dennis & Welsch 1978)."""

    def gain(self, squared: Array) -> Array:
        return np.exp(-squared)


@kernel
def triweight(squared: F4x2, out: F4x2) -> None:
    for k in range(len(squared)):
        for i in range(squared.shape[1]):
            rest = max(np.float32(1) - squared[k, i] / np.float32(9), np.float32(0))
            out[k, i] = rest * rest * rest


class Triweight(SummedGains):
    """(1 - r^2 / 9)^3 within three thresholds."""

    def gain(self, squared: Array) -> Array:
        rest = np.maximum(np.float32(1) - squared / np.float32(9), np.float32(0))
        return rest * rest * rest


class CompiledTriweight(SummedGains):
    gain_kernel = triweight


class BestHalf:
    """Samples from the better half of the matches."""

    uses_prior = False

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        best = np.argsort(pair.quality, kind="stable")[: max(size, pair.count // 2)]
        left = len(best) - np.arange(size)  # of which the next match is drawn
        index = (pair.uniform(start, count, size) * left).astype(np.int64).T
        for j in range(1, size):  # past those drawn before
            for drawn in np.sort(index[:j], axis=0):
                index[j] += index[j] >= drawn
        return best[index]


class Within2Px:
    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        return squared_px <= 4.0


class Sampled:
    """Samples as they are."""

    uses_prior = False

    def __init__(self, sample: Any) -> None:
        self.sample = sample

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Any:
        return self.sample(count, size) if callable(self.sample) else self.sample


class Scored:
    """Scores as they are."""

    prior_weighted = False

    def __init__(self, scores: Any) -> None:
        self.scores = scores

    def __call__(self, F: Array, which: Array, pair: Pair) -> Any:
        return self.scores(which)

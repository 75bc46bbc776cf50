"""`graph_cut` on the arrays of one pair: the same graph, the same labels but for rounding, the same draws."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.core.random import Stream, mixed_seed
from fmtorch.estimators import graph_cut
from fmtorch.estimators.graph_cut import FIRST_DRAW
from fmtorch.estimators.graph_cut_kernels import fits
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.scores import Score
from fmtorch.estimators.one_pair.selection import scored
from fmtorch.estimators.spatial import SHIFTS, SWEEPS, WINDOW
from fmtorch.estimators.spatial_kernels import MOST, curve_codes, label, neighbours


@runtime_checkable
class LocalOptimization(Protocol):
    """As `graph_cut.LocalOptimization`."""

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """The improved models (k, 9), float64."""
        ...


class GraphCut:
    """As `graph_cut.GraphCut`. score: of the engine."""

    def __init__(self, part: graph_cut.GraphCut, score: Score) -> None:
        self.part, self.score = part, score

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """As `LocalOptimization`."""
        graph = neighbor_graph(pair, self.part.RADIUS_PX)
        improved, score = F.copy(), scored(self.score, F, pair)
        for m in range(len(F)):
            for iteration in range(self.part.ITERATIONS):
                models = self.fits(self.labels(improved[m], pair, graph), pair, iteration)
                if not len(models):
                    break
                fit_score = scored(self.score, models, pair)
                best = int(np.argmax(fit_score))
                if not fit_score[best] > score[m]:
                    break
                improved[m], score[m] = models[best], fit_score[best]
        return improved

    def labels(self, F: Array, pair: OnePair, graph: tuple[Array, Array]) -> Array:
        """The inliers (n,) of a model (9,)."""
        out = np.empty(pair.count, np.bool_)
        scale = squared(pair.pixels_per_unit / self.part.threshold)
        label(F, pair.points, scale, *graph, self.part.COHERENCE, SWEEPS, out)
        return out

    def fits(self, labels: Array, pair: OnePair, iteration: int) -> Array:
        """Models (m, 9) of the inliers and of samples of them."""
        models, seed = np.empty((self.part.SAMPLES + 1, 9)), mixed_seed(pair.seed, Stream.SAMPLING)
        first = FIRST_DRAW + iteration * self.part.SAMPLES
        return models[: fits(pair.points, labels, seed, pair.key, first, self.part.SAMPLE_SIZE, models)]


def neighbor_graph(pair: OnePair, radius: float) -> tuple[Array, Array]:
    """As `spatial.neighbor_graph`: each match's neighbours (n, MOST), and how many these are (n,)."""
    codes, orders = np.empty(pair.count, np.int64), np.empty((len(SHIFTS), pair.count), np.int64)
    for shift, order in zip(SHIFTS, orders, strict=True):
        curve_codes(pair.points, shift, codes)
        order[:] = np.argsort(codes, kind="stable")
    graph, degree = np.empty((pair.count, MOST), np.int32), np.empty(pair.count, np.int32)
    neighbours(pair.points, orders, squared(radius / pair.pixels_per_unit), WINDOW, graph, degree)
    return graph, degree

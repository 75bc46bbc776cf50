"""The local optimisation of Graph-Cut RANSAC: good models made better from their spatially coherent inliers."""

from __future__ import annotations

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x2, I8x1
from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.compiling.scratch import matrix
from fmtorch.core.streams import Stream
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.parts.neighbours import Graph, label, neighbor_graph
from fmtorch.estimators.parts.scores import Score
from fmtorch.estimators.parts.selection import scores_of
from fmtorch.geometry.eight_point_kernels import weighted_eight_point

FIRST_DRAW = 1 << 32  # of the samples drawn here: beyond those of any search, so that they are others


class GraphCut:
    """The local optimisation of Graph-Cut RANSAC (Barath & Matas, CVPR 2018, algorithm 2).

    Label the matches with spatial coherence, fit the 8-point algorithm to samples of the inliers and to all of them,
    take the fit of the highest score, and again while the score rises. The samples hold seven times as many matches as
    a minimal one, as in the paper, here drawn with replacement.
    threshold: epsilon of the labelling, Sampson distance, px. score: what is improved.
    """

    COHERENCE = 0.1  # lambda; as the radius and the size of samples in section 4 of the paper
    RADIUS_PX = 20.0  # px, of the ball of neighbours in (x0, y0, x1, y1)
    SAMPLE_SIZE = 49
    SAMPLES = 20  # in each iteration
    ITERATIONS = 2  # at most; with 3, 2 of two models: AUC@0.05 41.7, 40.8 on every other tuning pair, two seeds

    def __init__(self, threshold: float, score: Score) -> None:
        self.threshold, self.score = threshold, score

    def __call__(self, F: Array, pair: Pair) -> Array:
        """As `LocalOptimization`."""
        graph = neighbor_graph(pair, self.RADIUS_PX)
        improved, score = F.copy(), scores_of(self.score, F, pair)
        for m in range(len(F)):
            for iteration in range(self.ITERATIONS):
                models = self.fits(self.labels(improved[m], pair, graph), pair, iteration)
                if not len(models):
                    break
                fit_score = scores_of(self.score, models, pair)
                best = int(np.argmax(fit_score))
                if not fit_score[best] > score[m]:
                    break
                improved[m], score[m] = models[best], fit_score[best]
        return improved

    def labels(self, F: Array, pair: Pair, graph: Graph) -> Array:
        """The inliers (n,) of a model (9,)."""
        out = np.empty(pair.count, np.bool_)
        label(F, pair.points, squared(pair.pixels_per_unit / self.threshold), graph, self.COHERENCE, out)
        return out

    def fits(self, labels: Array, pair: Pair, iteration: int) -> Array:
        """Models (m, 9) of the inliers and of samples of them."""
        models = np.empty((self.SAMPLES + 1, 9))
        stream = pair.mixed_seed(Stream.SAMPLING), pair.key, FIRST_DRAW + iteration * self.SAMPLES
        return models[: fit_samples(pair.points, labels, np.array(stream), self.SAMPLE_SIZE, models)]


@kernel
def fit_samples(points: F8x2, labels: B1x1, stream: I8x1, size: int, out: F8x2) -> int:
    """Models of all inliers of points (4, n), and of samples of these -> out (samples + 1, 9); how many there are.

    labels: (n,), the inliers. stream: (3,), the mixed seed, the key, the number of the first sample. size: matches of
    a sample, drawn with replacement.
    """
    state = stream_state(stream[0], stream[1])
    inliers, total = np.empty(len(labels), np.int64), 0
    for i in range(len(labels)):
        if labels[i]:
            inliers[total] = i
            total += 1
    if total == 0:
        return 0
    models, inlier_points, sample = 0, matrix(4, total), matrix(4, size)
    for i in range(total):
        for k in range(4):
            inlier_points[k, i] = points[k, inliers[i]]
    models += weighted_eight_point(inlier_points, np.ones(total), out[0])
    ones = np.ones(size)
    for s in range(len(out) - 1):
        for j in range(size):
            word = random_bits(state, (stream[2] + s) * size + j) >> np.uint64(31)
            drawn = np.int64(word * np.uint64(total) >> np.uint64(32))
            for k in range(4):
                sample[k, j] = inlier_points[k, drawn]
        models += weighted_eight_point(sample, ones, out[models])
    return models

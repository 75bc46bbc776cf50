"""The local optimisation of Graph-Cut RANSAC: good models made better from their spatially coherent inliers."""

from typing import Any, NamedTuple

import numpy as np

from fmtorch.estimators.inliers import residuals_squared
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.refinement import scores_of
from fmtorch.estimators.scores import Score
from fmtorch.geometry.eight_point import weighted_eight_point
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I4x1, I4x2, I8x1, I8x2, inner, kernel, matrix, vector
from fmtorch.jit.random import Stream, random_bits, stream_state

WINDOW = 8  # candidates for neighbours before and after each match along each curve
SHIFTS = (0.0, 0.5)  # of the grid of each curve; the two find 97 % of the edges within 20 px of real pairs
MAX_NEIGHBOURS = 32  # of a match: WINDOW on each side of it along each of two curves
SWEEPS = 8
CELLS = (1 << 15) - 1  # of the longest extent, along a curve
HALVINGS, FARTHEST = 10, 20.0  # exp(-z) is taken as (1 + z / 2^10)^-2^10, and as that of FARTHEST beyond
UNIT = 2.0**-10  # kernels are rounded to multiples of it, so that their sums are exact
ONE, TWO = np.float32(1), np.float32(2)


class Graph(NamedTuple):
    """Each match's neighbours (n, MAX_NEIGHBOURS), and how many these are (n,)."""

    neighbours: I4x2
    degree: I4x1


def neighbor_graph(pair: Pair, radius: float) -> Graph:
    """Matches within `radius` px of each other in (x0, y0, x1, y1), among those that are close along the curves."""
    codes, orders = np.empty(pair.count, np.int64), np.empty((len(SHIFTS), pair.count), np.int64)
    for shift, order in zip(SHIFTS, orders, strict=True):
        curve_codes(pair.points, shift, codes)
        order[:] = np.argsort(codes, kind="stable")
    graph = Graph(np.empty((pair.count, MAX_NEIGHBOURS), np.int32), np.empty(pair.count, np.int32))
    connect(pair.points, orders, squared(radius / pair.pixels_per_unit), WINDOW, graph)
    return graph


@kernel
def curve_codes(points: F8x2, shift: float, out: I8x1) -> None:
    """The places of points (4, n) along a curve (Z order of their cells, the grid shifted) -> out (n,)."""
    low, extent = vector(4), 1e-6
    for k in range(4):
        high = points[k, 0]
        low[k] = high
        for i in range(len(out)):
            low[k], high = min(low[k], points[k, i]), max(high, points[k, i])
        extent = max(extent, high - low[k])
    for i in range(len(out)):
        code = 0
        for k in range(4):
            cell = int(((points[k, i] - low[k]) / extent * 2 + shift) / 3 * CELLS)
            for bit in range(15):
                code |= ((cell >> bit) & 1) << (4 * bit + k)
        out[i] = code


@kernel
def connect(points: F8x2, orders: I8x2, limit: float, window: int, graph: Graph) -> None:
    """Matches within a squared distance of each other, among the `window` next ones along each curve -> graph.
    orders: (curves, n), along curves."""
    neighbours, degree = graph
    n = len(degree)
    for i in range(n):
        degree[i] = 0
    for c in range(len(orders)):
        for a in range(n):
            i = orders[c, a]
            for b in range(a + 1, min(a + 1 + window, n)):
                j, distance = orders[c, b], 0.0
                for k in range(4):
                    distance += (points[k, i] - points[k, j]) * (points[k, i] - points[k, j])
                if distance <= limit and not _among(neighbours[i], degree[i], j):
                    neighbours[i, degree[i]], neighbours[j, degree[j]] = j, i
                    degree[i] += 1
                    degree[j] += 1


@inner
def _among(members: Array, count: int, wanted: int) -> bool:
    place = 0
    while place < count and members[place] != wanted:
        place += 1
    return place < count


@kernel
def label(F: F8x1, points: F8x2, scale: float, graph: Graph, coherence: float, out: B1x1) -> None:
    """The inliers of a model (9,) among points (4, n) by the least energy -> out (n,).
    scale: one over the square of epsilon, in the unit of the points. coherence: lambda."""
    neighbours, degree = graph
    n = len(out)
    K, field, weight = np.empty(n, np.float32), np.empty(n, np.float32), np.float32(coherence)
    _gaussian(F, points, scale, K)
    for i in range(n):
        total = np.float32(0)
        for q in range(degree[i]):
            total += K[neighbours[i, q]]
        pulled = np.float32(degree[i]) * (ONE - K[i] / TWO) - total / TWO
        field[i] = ONE - TWO * K[i] + weight * pulled
    inside, outside = np.zeros(n, np.bool_), np.ones(n, np.bool_)
    _sweep(field, neighbours, degree, weight, inside)
    _sweep(field, neighbours, degree, weight, outside)
    lower = _energy(inside, K, neighbours, degree, coherence) <= _energy(outside, K, neighbours, degree, coherence)
    for i in range(n):
        out[i] = inside[i] if lower else outside[i]


@inner
def _gaussian(F: Array, points: Array, scale: float, K: Array) -> None:
    """The kernel K of the squared Sampson distances, times a scale -> K (n,)."""
    step, unit, r2 = np.float32(1 << HALVINGS), np.float32(UNIT), vector(len(K))
    residuals_squared(F, points, scale, r2)
    for i in range(len(K)):
        half = r2[i] / 2
        value = ONE + np.float32(half if half < FARTHEST else FARTHEST) / step
        for _ in range(HALVINGS):
            value = value * value
        K[i] = np.float32(np.rint(ONE / value / unit)) * unit


@inner
def _sweep(field: Array, neighbours: Array, degree: Array, weight: Any, labels: Array) -> None:
    """Labels (n,), all together, the best given their neighbours', again and again until none changes, in place."""
    before = np.empty_like(labels)
    for _ in range(SWEEPS):
        changed = False
        for i in range(len(labels)):
            before[i] = labels[i]
        for i in range(len(labels)):
            inliers = 0
            for q in range(degree[i]):
                inliers += before[neighbours[i, q]]
            labels[i] = field[i] < weight * np.float32(inliers)
            changed = changed or labels[i] != before[i]
        if not changed:
            break


@inner
def _energy(labels: Array, K: Array, neighbours: Array, degree: Array, coherence: float) -> float:
    unary, pairwise = 0.0, 0.0
    for i in range(len(labels)):
        unary += ONE - K[i] if labels[i] else K[i]
        for q in range(degree[i]):
            j = neighbours[i, q]
            if labels[i] != labels[j]:
                pairwise += 1.0
            else:
                shared = (float(K[i]) + float(K[j])) / 2
                pairwise += 1.0 - shared if labels[i] else shared
    return unary + coherence / 2 * pairwise  # an edge was seen from both ends


FIRST_DRAW = 1 << 32  # of the samples drawn here: beyond those of any search, so that they are others


class GraphCut:
    """The local optimisation of Graph-Cut RANSAC (Barath & Matas, CVPR 2018, algorithm 2).

    Label the matches with spatial coherence, fit the 8-point algorithm to samples of the inliers and to all of them,
    take the fit of the highest score, and again while the score rises. The samples hold seven times as many matches as
    a minimal one, as in the paper, here drawn with replacement.
    threshold: epsilon of the labelling, Sampson distance, px. score: what is improved."""

    COHERENCE = 0.1  # lambda; as the radius and the size of samples in section 4 of the paper
    RADIUS_PX = 20.0  # px, of the ball of neighbours in (x0, y0, x1, y1)
    SAMPLE_SIZE = 49
    SAMPLES = 20  # in each iteration
    ITERATIONS = 2  # at most; with 3, 2 of two models: AUC@0.05 41.7, 40.8 on every other tuning pair, two seeds

    def __init__(self, threshold: float, score: Score) -> None:
        self.threshold, self.score = threshold, score

    def __call__(self, F: Array, pair: Pair) -> Array:
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
    a sample, drawn with replacement."""
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

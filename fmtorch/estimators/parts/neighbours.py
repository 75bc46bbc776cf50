"""Which matches are a model's inliers, given that neighbours tend to be alike: the labelling of Graph-Cut RANSAC.

Barath & Matas, "Graph-Cut RANSAC" (CVPR 2018), section 3. A labelling L (1: inlier, 0: outlier) of the matches has the
energy ``E(L) = sum_p B(L_p) + lambda sum_(p, q) R(L_p, L_q)`` over matches p and over the edges of a neighbourhood
graph, each counted once. With the kernel ``K = exp(-r^2 / (2 epsilon^2))`` of a match's residual,

    B(0) = K_p, B(1) = 1 - K_p;    R(0, 0) = (K_p + K_q) / 2, R(1, 1) = 1 - (K_p + K_q) / 2, R(0, 1) = R(1, 0) = 1.

This is the paper's form, which is followed here. The released code differs: ``K = 1 - r^2 / (1.5 epsilon)^2``, in B
not cut off below zero and with B(1) = 0; each edge counts from both ends; and lambda is 0.14 for the paper's 0.1.
The paper's neighbours are the matches within a ball of 20 px in the space of (x0, y0, x1, y1); so they are here, as far
as they are close to each other along space-filling curves through that space.

E is submodular, and a least cut minimises it. Here it is minimised without one: fixed points of the labelling enclose
the least cut from above and below, and close in on it everywhere but in the few matches on which the two differ.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2, I4x1, I4x2, I8x1, I8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import vector
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.parts.inliers import residuals_squared

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

    orders: (curves, n), along curves.
    """
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
    """Whether a number is one of the first so many."""
    place = 0
    while place < count and members[place] != wanted:
        place += 1
    return place < count


@kernel
def label(F: F8x1, points: F8x2, scale: float, graph: Graph, coherence: float, out: B1x1) -> None:
    """The inliers of a model (9,) among points (4, n) by the least energy -> out (n,).

    scale: one over the square of epsilon, in the unit of the points. coherence: lambda.
    """
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
    """E of labels (n,)."""
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

"""`spatial` for the matches of one pair, compiled: the neighbourhood graph and the labelling of a model's matches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.estimators.pool_kernels import residuals_squared

Array = NDArray[Any]
MOST = 32  # neighbours of a match: WINDOW on each side of it along each of two curves
CELLS = (1 << 15) - 1  # of the longest extent, along a curve
HALVINGS, FARTHEST, UNIT = 10, 20.0, 2.0**-10  # as in `spatial`
ONE, TWO = np.float32(1), np.float32(2)


@kernel("f8[:, ::1], f8, i8[::1]")
def curve_codes(points: Array, shift: float, out: Array) -> None:
    """The places of points (4, n) along the curve of `curves.curve_order` -> out (n,)."""
    low, extent = np.empty(4), 1e-6
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


@kernel("f8[:, ::1], i8[:, ::1], f8, i8, i4[:, ::1], i4[::1]")
def neighbours(points: Array, orders: Array, limit: float, window: int, graph: Array, degree: Array) -> None:
    """`spatial.neighbor_graph` of points (4, n) -> the neighbours of each match, graph (n, MOST), and their number.

    orders: (curves, n), along curves, on each of which the `window` next ones are looked at. limit: squared distance.
    """
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
                if distance <= limit and not _among(graph[i], degree[i], j):
                    graph[i, degree[i]], graph[j, degree[j]] = j, i
                    degree[i] += 1
                    degree[j] += 1


@inner
def _among(some: Array, count: int, wanted: int) -> bool:
    """Whether a number is one of the first so many."""
    place = 0
    while place < count and some[place] != wanted:
        place += 1
    return place < count


@kernel("f8[::1], f8[:, ::1], f8, i4[:, ::1], i4[::1], f8, i8, b1[::1]")
def label(
    F: Array, points: Array, scale: float, graph: Array, degree: Array, coherence: float, sweeps: int, out: Array
) -> None:
    """`spatial.spatially_coherent_inliers` of a model (9,), points (4, n) and their `neighbours` -> out (n,).

    scale: one over the square of epsilon, in the unit of the points.
    """
    n = len(out)
    K, field, weight = np.empty(n, np.float32), np.empty(n, np.float32), np.float32(coherence)
    _gaussian(F, points, scale, K)
    for i in range(n):
        total = np.float32(0)
        for q in range(degree[i]):
            total += K[graph[i, q]]
        pulled = np.float32(degree[i]) * (ONE - K[i] / TWO) - total / TWO
        field[i] = ONE - TWO * K[i] + weight * pulled
    inside, outside = np.zeros(n, np.bool_), np.ones(n, np.bool_)
    _sweep(field, graph, degree, weight, sweeps, inside)
    _sweep(field, graph, degree, weight, sweeps, outside)
    lower = _energy(inside, K, graph, degree, coherence) <= _energy(outside, K, graph, degree, coherence)
    for i in range(n):
        out[i] = inside[i] if lower else outside[i]


@inner
def _gaussian(F: Array, points: Array, scale: float, K: Array) -> None:
    """`spatial.gaussian_kernel` of the squared Sampson distances, times a scale -> K (n,)."""
    step, unit, r2 = np.float32(1 << HALVINGS), np.float32(UNIT), np.empty(len(K))
    residuals_squared(F, points, scale, r2)
    for i in range(len(K)):
        half = r2[i] / 2
        value = ONE + np.float32(half if half < FARTHEST else FARTHEST) / step
        for _ in range(HALVINGS):
            value = value * value
        K[i] = np.float32(np.rint(ONE / value / unit)) * unit


@inner
def _sweep(field: Array, graph: Array, degree: Array, weight: Any, sweeps: int, labels: Array) -> None:
    """Labels (n,), all together, the best given their neighbours', again and again until none changes, in place."""
    before = np.empty_like(labels)
    for _ in range(sweeps):
        changed = False
        for i in range(len(labels)):
            before[i] = labels[i]
        for i in range(len(labels)):
            inliers = 0
            for q in range(degree[i]):
                inliers += before[graph[i, q]]
            labels[i] = field[i] < weight * np.float32(inliers)
            changed = changed or labels[i] != before[i]
        if not changed:
            break


@inner
def _energy(labels: Array, K: Array, graph: Array, degree: Array, coherence: float) -> float:
    """`spatial.energy` of labels (n,)."""
    unary, pairwise = 0.0, 0.0
    for i in range(len(labels)):
        unary += ONE - K[i] if labels[i] else K[i]
        for q in range(degree[i]):
            j = graph[i, q]
            if labels[i] != labels[j]:
                pairwise += 1.0
            else:
                shared = (float(K[i]) + float(K[j])) / 2
                pairwise += 1.0 - shared if labels[i] else shared
    return unary + coherence / 2 * pairwise  # an edge was seen from both ends

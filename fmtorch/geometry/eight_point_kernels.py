"""The eight-point algorithm on the samples of one pair, and weighted on its matches, compiled; float64."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, F4x2, F8x1, F8x2, I8x1, I8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, absolute, fill, load, sqrt, store, where
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.nullspace_kernels import equations, gather, null_space
from fmtorch.geometry.orientation_kernels import consistently_oriented
from fmtorch.geometry.rank2_kernels import EPS, nearest_rank2

WIDTH = 32  # partial sums over the matches: part of the last bits of a weighted fit
SHIFT, RANK_TOLERANCE, SQUARINGS = 1e-14, 1e-12, 14  # as in `eigenvector`


@kernel
def eight_point(points: F8x2, sample: I8x2, F: F4x2, draw: I8x1) -> int:
    """Consistently oriented models of samples (8, s) of points (4, n) -> F (s, 9), draw (s,); how many there are.

    The models stand in the order of the samples. Buffers are rows of LANES numbers, one per sample.
    """
    X, N, A, B = matrix(32, LANES), matrix(32, LANES), matrix(72, LANES), matrix(9, LANES)
    work, there = matrix(8, LANES), np.empty((1, LANES), np.bool_)
    centre, scale, f = matrix(4, LANES), matrix(2, LANES), vector(9)
    models = 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        for image in range(2):
            _normalise(X, image, N, centre, scale)
        equations(N, 8, A)
        store(there, 0, null_space(A, 8, B, work) & (load(scale, 0) > 0.0) & (load(scale, 1) > 0.0))
        for lane in range(LANES):
            for q in range(9):
                f[q] = B[q, lane]
            nearest_rank2(f)
            for image in range(2):
                _denormalise(f, image, scale[image, lane], centre[2 * image, lane], centre[2 * image + 1, lane])
            norm = 0.0
            for q in range(9):
                norm += f[q] * f[q]
            norm = math.sqrt(norm)
            for q in range(9):
                B[q, lane] = f[q] / norm
            there[0, lane] &= norm > 0 and math.isfinite(norm)
        store(there, 0, load(there, 0) & consistently_oriented(B, X, 8))
        for lane in range(min(LANES, sample.shape[1] - first)):
            if there[0, lane]:
                for q in range(9):
                    F[models, q] = B[q, lane]
                draw[models] = first + lane
                models += 1
    return models


@inner
def _normalise(X: Array, image: int, N: Array, centre: Array, scale: Array) -> None:
    """Each sample's points in one image, normalised (Hartley 1997) -> N, centre and scale; scale 0: no spread."""
    x, y = 2 * image, 2 * image + 1  # rows of each point
    cx, cy, mean = fill(0.0), fill(0.0), fill(0.0)
    for j in range(0, 32, 4):
        cx += load(X, j + x)
        cy += load(X, j + y)
    cx, cy = cx / 8.0, cy / 8.0
    for j in range(0, 32, 4):
        dx, dy = load(X, j + x) - cx, load(X, j + y) - cy
        mean += sqrt(dx * dx + dy * dy)
    mean /= 8.0
    farthest = where(absolute(cx) > absolute(cy), absolute(cx), absolute(cy))
    spread = mean > 4 * EPS * farthest
    by = where(spread, 2**0.5 / mean, 1.0)
    for j in range(0, 32, 4):
        store(N, j + x, (load(X, j + x) - cx) * by)
        store(N, j + y, (load(X, j + y) - cy) * by)
    store(centre, x, cx)
    store(centre, y, cy)
    store(scale, image, where(spread, by, 0.0))


@inner
def _denormalise(f: Array, image: int, s: float, cx: float, cy: float) -> None:
    """F for points of image 0 (or of image 1: F's rows) before they were moved from (cx, cy) and scaled, in place."""
    across, along = (1, 3) if image == 0 else (3, 1)
    for k in range(3):
        a, b, c = k * along, k * along + across, k * along + 2 * across
        f[a], f[b] = f[a] * s, f[b] * s
        f[c] -= f[a] * cx + f[b] * cy


@kernel
def weighted_eight_point(points: F8x2, weight: F8x1, F: F8x1) -> bool:
    """The F of least sum w (x1^T F x0)^2, made rank two, of unit norm, largest entry positive -> F (9,).

    `eight_point.eight_point` of points (4, n) and weights (n,), not negative: whether there is one.
    """
    n, largest = len(weight), 0.0
    for i in range(n):
        largest = max(largest, weight[i])
    if not (largest > 0 and math.isfinite(largest)):
        return False
    blocks = (n + WIDTH - 1) // WIDTH
    X, w = np.zeros((4, blocks * WIDTH)), np.zeros(blocks * WIDTH)
    similarity = matrix(2, 3)
    for i in range(n):
        w[i] = weight[i] / largest
        for k in range(4):
            X[k, i] = points[k, i]
    for image in range(2):
        _similarity(X[2 * image], X[2 * image + 1], w, similarity[image])
    M = _normal_matrix(X, w)
    solved = smallest_eigenvector(M, F)
    if not solved:
        return False
    nearest_rank2(F)
    for image in range(2):
        _denormalise(F, image, similarity[image, 0], similarity[image, 1], similarity[image, 2])
    peak, norm = 0, 0.0
    for q in range(9):
        peak = q if abs(F[q]) > abs(F[peak]) else peak
    for q in range(9):
        norm += F[q] * F[q]
    norm = math.copysign(math.sqrt(norm), F[peak])
    for q in range(9):
        F[q] /= norm
    return math.isfinite(norm) and norm != 0


@inner
def _similarity(x: Array, y: Array, w: Array, out: Array) -> None:
    """Normalises points (n,) in place; their scale and centre -> out (3,). The means are weighted."""
    total, sums = 0.0, np.zeros((4, WIDTH))
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            sums[0, i] += w[b + i]
            sums[1, i] += w[b + i] * x[b + i]
            sums[2, i] += w[b + i] * y[b + i]
    total, cx, cy, mean = _added(sums[0]), _added(sums[1]), _added(sums[2]), 0.0
    cx, cy = cx / total, cy / total
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            x[b + i] -= cx
            y[b + i] -= cy
            sums[3, i] += w[b + i] * math.sqrt(x[b + i] * x[b + i] + y[b + i] * y[b + i])
    mean = _added(sums[3]) / total
    scale = 2**0.5 / mean if mean > 4 * EPS * max(abs(cx), abs(cy)) else 1.0
    for i in range(len(w)):
        x[i], y[i] = x[i] * scale, y[i] * scale
    out[0], out[1], out[2] = scale, cx, cy


@inner
def _added(sums: Array) -> Any:
    """The sum of WIDTH partial sums, in order."""
    total = 0.0
    for i in range(WIDTH):
        total += sums[i]
    return total


@inner
def _normal_matrix(X: Array, w: Array) -> Array:
    """The sum of w a a^T with a . vec(F) = x1^T F x0, (9, 9), of points (4, n), n a multiple of WIDTH."""
    p, q, sums = matrix(6, WIDTH), matrix(6, WIDTH), np.zeros((36, WIDTH))
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            x0, y0, x1, y1, v = X[0, b + i], X[1, b + i], X[2, b + i], X[3, b + i], w[b + i]
            p[0, i], p[1, i], p[2, i], p[3, i], p[4, i], p[5, i] = x0 * x0, x0 * y0, y0 * y0, x0, y0, 1.0
            q[0, i], q[1, i], q[2, i] = v * (x1 * x1), v * (x1 * y1), v * (y1 * y1)
            q[3, i], q[4, i], q[5, i] = v * x1, v * y1, v
        for r in range(6):
            for c in range(6):
                for i in range(WIDTH):
                    sums[6 * r + c, i] += q[r, i] * p[c, i]
    M, product = matrix(9, 9), np.array(((0, 1, 3), (1, 2, 4), (3, 4, 5)))
    for i in range(9):
        for j in range(9):
            M[i, j] = _added(sums[6 * product[i // 3, j // 3] + product[i % 3, j % 3]])
    return M


@inner
def smallest_eigenvector(M: Array, v: Array) -> bool:
    """`eigenvector.smallest_eigenvector` of a symmetric matrix (n, n), overwritten -> v; whether it is determined."""
    n, trace = len(M), 0.0
    for i in range(n):
        trace += M[i, i]
    if not (trace > 0 and math.isfinite(trace)):
        return False
    L, X, Y = np.eye(n), matrix(n, n), matrix(n, n)
    pivot = vector(n)
    for i in range(n):
        for j in range(n):
            M[i, j] /= trace
        M[i, i] += SHIFT
    for k in range(n):  # M = L D L^T; L becomes the inverse of L
        pivot[k] = max(M[k, k], SHIFT / 2)
        for i in range(k + 1, n):
            factor = M[i, k] / pivot[k]
            for j in range(k + 1):
                L[i, j] -= factor * L[k, j]
            for j in range(k + 1, n):
                M[i, j] -= factor * M[k, j]
    size = 0.0
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += L[k, i] / pivot[k] * L[k, j]
            X[i, j] = total
        size += X[i, i]
    inverse = X / size
    X = inverse.copy()
    for _ in range(SQUARINGS):
        trace = 0.0
        for i in range(n):
            for j in range(n):
                Y[i, j] = 0.0
            for k in range(n):
                for j in range(n):
                    Y[i, j] += X[i, k] * X[k, j]
            trace += Y[i, i]
        for i in range(n):
            for j in range(n):
                X[i, j] = Y[i, j] / trace
        if trace > 1 - 1e-14:
            break
    best, norm, along = 0, 0.0, 0.0
    for i in range(n):
        best = i if X[i, i] > X[best, best] else best
    for i in range(n):
        norm += X[best, i] * X[best, i]
    for i in range(n):
        v[i] = X[best, i] / math.sqrt(norm)
    for i in range(n):
        for j in range(n):
            along += v[i] * inverse[i, j] * v[j]
    return (1 - along) * size * RANK_TOLERANCE < 1

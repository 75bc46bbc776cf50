"""The seven-point algorithm on the samples of one pair, compiled; float64, models in float32."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.cubic_kernels import cubic_roots
from fmtorch.geometry.nullspace_kernels import LANES, equations, gather, null_space
from fmtorch.geometry.orientation_kernels import consistently_oriented
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
HALF = 0.5**0.5


@kernel("f8[:, ::1], i8[:, ::1], f4[:, ::1], i8[::1]")
def seven_point(points: Array, sample: Array, F: Array, draw: Array) -> int:
    """Consistently oriented models of samples (7, s) of points (4, n) -> F (3 s, 9), draw (3 s,); how many there are.

    They stand in the order of the samples, and of one sample in that of `minimal.seven_point_components`.
    """
    X, A, B = np.empty((4, 7 * LANES)), np.empty((63, LANES)), np.empty((18, LANES))
    work, full_rank, p = np.empty((9, LANES)), np.empty(LANES, np.bool_), np.empty((4, LANES))
    c, roots, valid, f = np.empty(4), np.empty(3), np.empty(3, np.bool_), np.empty(9)
    models = 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, 7, X)
        equations(X, 7, A)
        null_space(A, 7, B, full_rank, work)
        _determinants(B, p)
        for lane in range(min(LANES, sample.shape[1] - first)):
            if not full_rank[lane]:
                continue
            turned, exchanged = _coefficients(p, lane, c)
            cubic_roots(c, roots, valid)
            for k in range(3):
                if not valid[k]:
                    continue
                a = 1.0 / math.sqrt(1.0 + roots[k] * roots[k])
                b = roots[k] * a
                if exchanged:
                    a, b = b, a
                if turned:
                    a, b = (a + b) * HALF, (a - b) * HALF
                finite = True
                for q in range(9):
                    f[q] = a * B[q, lane] + b * B[9 + q, lane]
                    finite = finite and math.isfinite(f[q])
                if finite and consistently_oriented(f, X, 7, LANES, lane):
                    for q in range(9):
                        F[models, q] = f[q]
                    draw[models] = first + lane
                    models += 1
    return models


@inner
def _determinants(B: Array, p: Array) -> None:
    """det(a F0 + b F1) at (1, 0), (0, 1), and their sum and difference over the root of two -> p (4, LANES)."""
    for k in range(4):
        a, b = (1.0 - k, float(k)) if k < 2 else (HALF, HALF if k == 2 else -HALF)
        for i in range(LANES):
            f0 = a * B[0, i] + b * B[9, i]
            f1 = a * B[1, i] + b * B[10, i]
            f2 = a * B[2, i] + b * B[11, i]
            f3 = a * B[3, i] + b * B[12, i]
            f4 = a * B[4, i] + b * B[13, i]
            f5 = a * B[5, i] + b * B[14, i]
            f6 = a * B[6, i] + b * B[15, i]
            f7 = a * B[7, i] + b * B[16, i]
            f8 = a * B[8, i] + b * B[17, i]
            p[k, i] = f0 * (f4 * f8 - f5 * f7) + f1 * (f5 * f6 - f3 * f8) + f2 * (f3 * f7 - f4 * f6)


@inner
def _coefficients(p: Array, lane: int, c: Array) -> tuple[bool, bool]:
    """The cubic of a basis that keeps its roots finite -> c (4,); whether it was turned by 45 degrees, exchanged.

    As `minimal._cubic`, from the determinants at (1, 0), (0, 1), and at their sum and difference over the root of two.
    """
    best = 0
    for k in range(1, 4):
        if abs(p[k, lane]) > abs(p[best, lane]):
            best = k
    turned, exchanged = best >= 2, best == 0 or best == 2
    first, last, plus, minus = p[0, lane], p[1, lane], p[2, lane], p[3, lane]
    if turned:
        first, last, plus, minus = plus, minus, first, last
    s, d = plus * 2**1.5, minus * 2**1.5
    if exchanged:
        first, last, d = last, first, -d
    c[0], c[1], c[2], c[3] = last, (s + d) / 2 - first, (s - d) / 2 - last, first
    return turned, exchanged

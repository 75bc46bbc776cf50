"""The seven-point algorithm on the samples of one pair, compiled; float64, LANES samples at a time, models in float32.

Buffers are rows of LANES numbers, one a sample.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x2, F4x2, F8x2, F8x3, I8x1, I8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, absolute, load, store
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.cubic_kernels import cubic_roots
from fmtorch.geometry.nullspace_kernels import equations, gather, null_space
from fmtorch.geometry.orientation_kernels import consistently_oriented

HALF = 0.5**0.5


@kernel
def seven_point(points: F8x2, sample: I8x2, F: F4x2, draw: I8x1) -> int:
    """Consistently oriented models of samples (7, s) of points (4, n) -> F (3 s, 9), draw (3 s,); how many there are.

    They stand in the order of the samples, and of one sample in that of the roots of its cubic.
    """
    X, f, there = matrix(28, LANES), np.empty((3, 9, LANES)), np.empty((3, LANES), np.bool_)
    models, work = 0, _room()
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        _solve(X, work, f, there)
        for k in range(3):
            store(there, k, load(there, k) & consistently_oriented(f[k], X, 7))
        for lane in range(min(LANES, sample.shape[1] - first)):
            for k in range(3):
                if there[k, lane]:
                    for q in range(9):
                        F[models, q] = f[k, q, lane]
                    draw[models] = first + lane
                    models += 1
    return models


@kernel
def all_seven_point(points: F8x2, sample: I8x2, F: F8x3, valid: B1x2) -> None:
    """All models of samples (7, s) of points (4, n) -> F (s, 3, 9), of unit norm; which slots hold one -> valid (s, 3).

    Those without one are zero.
    """
    X, f, there = matrix(28, LANES), np.empty((3, 9, LANES)), np.empty((3, LANES), np.bool_)
    work = _room()
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        _solve(X, work, f, there)
        for lane in range(min(LANES, sample.shape[1] - first)):
            for k in range(3):
                valid[first + lane, k] = there[k, lane]
                for q in range(9):
                    F[first + lane, k, q] = f[k, q, lane] if there[k, lane] else 0.0


class _Work(NamedTuple):
    """Buffers of `_solve`: equations, null space, its scales, determinants, mixtures, and which samples have rank 7."""

    A: Array
    B: Array
    scale: Array
    p: Array
    mixed: Array
    full_rank: Array


@inner
def _room() -> Any:
    return _Work(
        matrix(63, LANES), matrix(18, LANES), matrix(7, LANES), matrix(4, LANES), matrix(6, LANES),
        np.empty((1, LANES), np.bool_),
    )  # fmt: skip


@inner
def _solve(X: Array, work: Any, f: Array, there: Array) -> None:
    """Of LANES samples X (28, LANES) the singular matrices of the null space -> f (3, 9, LANES), there (3, LANES).

    The null space is spanned by F0 and F1; det(a F0 + b F1) = 0 is a cubic (Hartley and Zisserman, 11.1.2).
    """
    equations(X, 7, work.A)
    store(work.full_rank, 0, null_space(work.A, 7, work.B, work.scale))
    _determinants(work.B, work.p)
    for lane in range(LANES):
        _mixtures(work.p, lane, work.full_rank[0, lane], work.mixed, there)
    for k in range(3):
        a, b = load(work.mixed, 2 * k), load(work.mixed, 2 * k + 1)
        finite = load(there, k)
        for q in range(9):
            value = a * load(work.B, q) + b * load(work.B, 9 + q)
            finite &= absolute(value) < math.inf
            store(f[k], q, value)
        store(there, k, finite)


@inner
def _determinants(B: Array, p: Array) -> None:
    """det(a F0 + b F1) at (1, 0), (0, 1), and their sum and difference over the root of two -> p (4, LANES)."""
    f = matrix(9, LANES)
    for k in range(4):
        a, b = (1.0 - k, float(k)) if k < 2 else (HALF, HALF if k == 2 else -HALF)
        for q in range(9):
            store(f, q, a * load(B, q) + b * load(B, 9 + q))
        c0 = load(f, 4) * load(f, 8) - load(f, 5) * load(f, 7)
        c1 = load(f, 5) * load(f, 6) - load(f, 3) * load(f, 8)
        c2 = load(f, 3) * load(f, 7) - load(f, 4) * load(f, 6)
        store(p, k, load(f, 0) * c0 + load(f, 1) * c1 + load(f, 2) * c2)


@inner
def _mixtures(p: Array, lane: int, full_rank: bool, mixed: Array, there: Array) -> None:
    """The singular matrices a F0 + b F1 of a sample -> a, b of each in two rows of mixed; whether there is one."""
    c, roots, valid = vector(4), np.zeros(3), np.zeros(3, np.bool_)
    turned, exchanged = _coefficients(p, lane, c)
    if full_rank:
        cubic_roots(c, roots, valid)
    for k in range(3):
        a = 1.0 / math.sqrt(1.0 + roots[k] * roots[k])
        b = roots[k] * a
        if exchanged:
            a, b = b, a
        if turned:
            a, b = (a + b) * HALF, (a - b) * HALF
        mixed[2 * k, lane], mixed[2 * k + 1, lane], there[k, lane] = a, b, valid[k]


@inner
def _coefficients(p: Array, lane: int, c: Array) -> tuple[bool, bool]:
    """The cubic of a basis that keeps its roots finite -> c (4,); whether it was turned by 45 degrees, exchanged.

    From the determinants at (1, 0), (0, 1), and at their sum and difference over the root of two. The cubic vanishes in
    at most three directions, so one of these four can be sent to infinity: the basis is turned and exchanged until the
    leading coefficient is the largest of the four, and no solution is lost at infinity.
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

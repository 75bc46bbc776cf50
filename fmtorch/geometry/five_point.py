"""The five-point algorithm on the samples of one pair, compiled; float64, LANES samples at a time, models in float32.

Nister, "An efficient solution to the five-point relative pose problem" (PAMI 2004). Real roots of the polynomial of
degree ten are those across which it changes its sign between the points of a grid. Buffers are rows of LANES numbers,
one a sample.
E = x X + y Y + z Z + W; a monomial is a sorted triple of 0 to 3 for x, y, z, 1, in the order of the paper."""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.geometry.eight_point import add_models, equations, gather, null_space
from fmtorch.geometry.pose import consistently_oriented
from fmtorch.jit.kernel import Array, F4x2, F8x1, F8x2, I8x1, I8x2, inner, kernel, matrix
from fmtorch.jit.lanes import LANES, absolute, any_lane, fill, load, sqrt, store, where

_MONOMIALS = (
    "000", "111", "001", "011", "002", "003", "112", "113", "012", "013",
    "022", "023", "033", "122", "123", "133", "222", "223", "233", "333",
)  # fmt: skip
_PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))
FIRST, SECOND = (np.array([pair[k] for pair in _PAIRS]) for k in (0, 1))
MONOMIAL = np.array([[_MONOMIALS.index("".join(map(str, sorted((*pair, c))))) for c in range(4)] for pair in _PAIRS])


@kernel
def five_point(points: F8x2, sample: I8x2, depth: F8x2, offset: F8x1, F: F4x2, draw: I8x1) -> int:
    """Consistently oriented models of samples (5, s) of points (4, n) -> F (10 s, 9), draw (10 s,); their number.
    points: from the principal points. depth: (2, s), the focal lengths of each sample, in the unit of the points.
    offset: (4,), from the centre of the coordinates that F is for to the principal points. In the order of the samples.
    """
    X, depths, A, e = matrix(20, LANES), matrix(2, LANES), matrix(45, LANES), matrix(36, LANES)
    scale, C, B, p = matrix(5, LANES), matrix(200, LANES), matrix(45, LANES), matrix(11, LANES)
    roots, right = room_for_roots(), np.empty((DEGREE, LANES), np.bool_)
    E, uncalibrated = matrix(9, LANES), np.empty((DEGREE, 9, LANES))
    models = 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        for i in range(LANES):
            for k in range(2):
                depths[k, i] = depth[k, min(first + i, sample.shape[1] - 1)]
        for k in range(20):
            store(X, k, load(X, k) / load(depths, k % 4 // 2))
        equations(X, 5, A)
        full_rank = null_space(A, 5, e, scale)
        _constraints(e, C)
        _eliminate(C)
        _polynomials(C, B)
        _determinant(B, p)
        rows = real_roots(p, full_rank, roots)
        for s in range(rows):
            there = load(roots.exists, s) & _essential(B, e, load(roots.far, s), load(roots.z, s), E)
            there &= consistently_oriented(E, X, 5)
            store(right, s, there & _uncalibrated(E, depths, offset, uncalibrated[s]))
        models = add_models(uncalibrated, right[:rows], first, F, draw, models, sample.shape[1])
    return models


@inner
def _constraints(e: Array, A: Array) -> None:
    """``det E = 0`` and ``E E^T E - tr(E E^T) E / 2 = 0`` for E = x X + y Y + z Z + W -> A (10 20, LANES).
    e: (4 9, LANES), the basis X, Y, Z, W."""
    Q, N, zero = matrix(9, LANES), matrix(3, LANES), fill(0.0)
    for r in range(200):
        store(A, r, zero)
    for pair in range(10):
        a, b = 9 * FIRST[pair], 9 * SECOND[pair]
        _quadratic_forms(e, a, b, 0.5 if a == b else 1.0, Q, N)
        for c in range(4):
            m, o = MONOMIAL[pair, c], 9 * c
            determinant = load(N, 0) * load(e, o) + load(N, 1) * load(e, o + 1) + load(N, 2) * load(e, o + 2)
            store(A, m, load(A, m) + determinant)
            for row in range(3):
                q0, q1, q2 = load(Q, 3 * row), load(Q, 3 * row + 1), load(Q, 3 * row + 2)
                for column in range(3):
                    w, f = (1 + 3 * row + column) * 20 + m, o + column
                    product = q0 * load(e, f) + q1 * load(e, f + 3) + q2 * load(e, f + 6)
                    store(A, w, load(A, w) + product)


@inner
def _quadratic_forms(e: Array, a: int, b: int, share: float, Q: Array, N: Array) -> None:
    """Of the product of two unknowns the coefficients of E E^T - tr / 2 -> Q (3 3,) and of minors of E -> N (3,)."""
    for row in range(3):
        for column in range(row, 3):
            p, q, r, s = a + 3 * row, b + 3 * column, b + 3 * row, a + 3 * column
            value = load(e, p) * load(e, q) + load(e, p + 1) * load(e, q + 1)
            value += load(e, p + 2) * load(e, q + 2)
            value += load(e, r) * load(e, s) + load(e, r + 1) * load(e, s + 1)
            value = (value + load(e, r + 2) * load(e, s + 2)) * share
            store(Q, 3 * row + column, value)
            store(Q, 3 * column + row, value)
    half = (load(Q, 0) + load(Q, 4) + load(Q, 8)) / 2.0
    for k in range(0, 9, 4):
        store(Q, k, load(Q, k) - half)
    for k in range(3):  # rows 1 and 2 without column k
        p, q, r, s = 3 + (k + 1) % 3, 6 + (k + 2) % 3, 3 + (k + 2) % 3, 6 + (k + 1) % 3
        value = load(e, a + p) * load(e, b + q) - load(e, a + r) * load(e, b + s)
        store(N, k, (value + load(e, b + p) * load(e, a + q) - load(e, b + r) * load(e, a + s)) * share)


@inner
def _eliminate(A: Array) -> None:
    """Gauss elimination of A (10 20, LANES) without pivoting, in place; wholly of the last six rows."""
    for k in range(10):
        inverse = 1.0 / load(A, 21 * k)
        for c in range(k + 1, 20):
            store(A, 20 * k + c, load(A, 20 * k + c) * inverse)
        for r in range(k + 1, 10):
            _subtract(A, 20 * r + k, 20 * r, 20 * k, k + 1)
    for r in range(8, 3, -1):
        for k in range(9, r, -1):
            _subtract(A, 20 * r + k, 20 * r, 20 * k, 10)


@inner
def _subtract(A: Array, factor: int, row: int, other: int, first: int) -> None:
    """Subtracts from a row the factor times the other one, from a column on."""
    by = load(A, factor)
    for c in range(first, 20):
        store(A, row + c, load(A, row + c) - by * load(A, other + c))


@inner
def _polynomials(A: Array, B: Array) -> None:
    """The 3 x 3 matrix of polynomials in z, highest power first, of null vector (x, y, 1) -> B (3 3 5, LANES)."""
    zero = fill(0.0)
    for q in range(45):
        store(B, q, zero)
    for r in range(3):
        for column in range(3):
            first, count = 10 + 3 * column, 4 if column == 2 else 3
            for s in range(count):
                o = (3 * r + column) * 5 + 5 - count + s
                p, q = 20 * (4 + 2 * r) + first + s, 20 * (5 + 2 * r) + first + s
                store(B, o, load(B, o) + load(A, p))
                store(B, o - 1, load(B, o - 1) - load(A, q))


@inner
def _determinant(B: Array, p: Array) -> None:
    """The determinant of B, a polynomial of degree ten -> p (11, LANES)."""
    minor, zero = matrix(7, LANES), fill(0.0)
    for q in range(11):
        store(p, q, zero)
    for r in range(3):
        s, t = (r + 1) % 3, (r + 2) % 3
        for q in range(7):
            store(minor, q, zero)
        _multiply(B, 15 * s + 1, 4, B, 15 * t + 6, 4, 1.0, minor)
        _multiply(B, 15 * s + 6, 4, B, 15 * t + 1, 4, -1.0, minor)
        _multiply(minor, 0, 7, B, 15 * r + 10, 5, 1.0, p)


@inner
def _multiply(a: Array, o: int, m: int, b: Array, q: int, n: int, sign: float, out: Array) -> None:
    """Adds to a polynomial the product of two of m and n coefficients, which begin at a[o] and b[q]."""
    for j in range(m):
        factor = sign * load(a, o + j)
        for k in range(n):
            store(out, j + k, load(out, j + k) + factor * load(b, q + k))


@inner
def _essential(B: Array, e: Array, far: Any, z: Any, E: Array) -> Any:
    """The essential matrix of a root of each sample, of unit norm -> E (9, LANES); a mask: whether there is one."""
    m = matrix(9, LANES)
    for q in range(9):
        value = where(far, load(B, 5 * q + 4), load(B, 5 * q))
        for d in range(1, 5):
            value = where(far, load(B, 5 * q + 4 - d), load(B, 5 * q + d)) + value * z
        store(m, q, value)
    zero = fill(0.0)
    x, y, homogeneous, most = zero, zero, zero, fill(-1.0)
    for r in range(3):  # the longest cross product of two rows
        a, b = 3 * r, 3 * ((r + 1) % 3)
        c0 = load(m, a + 1) * load(m, b + 2) - load(m, a + 2) * load(m, b + 1)
        c1 = load(m, a + 2) * load(m, b) - load(m, a) * load(m, b + 2)
        c2 = load(m, a) * load(m, b + 1) - load(m, a + 1) * load(m, b)
        length2 = c0 * c0 + c1 * c1 + c2 * c2
        longer = length2 > most
        x, y, homogeneous = where(longer, c0, x), where(longer, c1, y), where(longer, c2, homogeneous)
        most = where(longer, length2, most)
    w0, w1 = where(far, x * z, x), where(far, y * z, y)
    w2, w3 = where(far, homogeneous, homogeneous * z), where(far, homogeneous * z, homogeneous)
    norm = zero
    for q in range(9):
        value = load(e, q) * w0 + load(e, 9 + q) * w1
        value += load(e, 18 + q) * w2 + load(e, 27 + q) * w3
        store(E, q, value)
        norm += value * value
    norm = sqrt(norm)
    for q in range(9):
        store(E, q, load(E, q) / norm)
    return (norm > 0.0) & (norm < math.inf)


@inner
def _uncalibrated(E: Array, depth: Array, offset: Array, F: Array) -> Any:
    """Fundamental matrices of cameras of these focal lengths, of unit norm -> F (9, LANES); a mask: whether finite.
    E: (9, LANES), overwritten. depth: (2, LANES)."""
    for k in range(3):
        store(E, 3 * k + 2, load(E, 3 * k + 2) * load(depth, 0))
    for k in range(3):
        store(E, 6 + k, load(E, 6 + k) * load(depth, 1))
    for k in range(3):
        moved = offset[0] * load(E, 3 * k) + offset[1] * load(E, 3 * k + 1)
        store(E, 3 * k + 2, load(E, 3 * k + 2) + moved)
    for k in range(3):
        moved = offset[2] * load(E, k) + offset[3] * load(E, 3 + k)
        store(E, 6 + k, load(E, 6 + k) + moved)
    norm = fill(0.0)
    for q in range(9):
        norm += load(E, q) * load(E, q)
    norm = sqrt(norm)
    for q in range(9):
        store(F, q, load(E, q) / norm)
    return (norm > 0.0) & (norm < math.inf)


# Real roots of polynomials of degree ten, LANES samples at a time, compiled: signs on a grid, then Newton

KNOTS, POLISHING_STEPS = 33, 4  # of the grid in each of two charts; of Newton's method, from the secant
DEGREE = 10


class Roots(NamedTuple):
    """Of LANES polynomials, their first roots in rows 0, their second in rows 1, ... (DEGREE, LANES).
    far: whether in the second chart, in which z is the inverse of the root. exists: whether there is one.
    low, high, below, above: places of different sign around it, and the values there."""

    z: Array
    far: Array
    exists: Array
    low: Array
    high: Array
    below: Array
    above: Array


@inner
def room_for_roots() -> Any:
    """Buffers for `real_roots`."""
    z, far, exists = matrix(DEGREE, LANES), np.empty((DEGREE, LANES), np.bool_), np.empty((DEGREE, LANES), np.bool_)
    low, high = matrix(DEGREE, LANES), matrix(DEGREE, LANES)
    return Roots(z, far, exists, low, high, matrix(DEGREE, LANES), matrix(DEGREE, LANES))


@inner
def real_roots(p: Array, valid: Any, roots: Any) -> int:
    """Real roots of p (DEGREE + 1, LANES), highest power first, in their order -> roots; how many rows of them.
    valid: a mask; of other polynomials there are none."""
    size, most = fill(0.0), 0
    for d in range(DEGREE + 1):
        magnitude = absolute(load(p, d))
        size = where(magnitude <= size, size, magnitude)
    valid = valid & (size > 0.0) & (size < math.inf)
    values, change, number = matrix(KNOTS, LANES), np.empty((1, LANES), np.bool_), np.zeros(LANES, np.int64)
    for s in range(DEGREE):
        store(roots.exists, s, size != size)
        store(roots.far, s, size != size)
        store(roots.low, s, fill(0.0))
        store(roots.high, s, fill(1.0))
        store(roots.below, s, fill(-1.0))
        store(roots.above, s, fill(1.0))
    for chart in range(2):
        for k in range(KNOTS):
            store(values, k, _value(p, chart == 1, _knot(chart, k)))
        for k in range(KNOTS - 1):
            changes = valid & ((load(values, k) < 0.0) ^ (load(values, k + 1) < 0.0))
            if not any_lane(changes):
                continue
            store(change, 0, changes)
            for i in range(LANES):
                s = number[i]
                if change[0, i] and s < DEGREE:
                    roots.exists[s, i], roots.far[s, i] = True, chart == 1
                    roots.low[s, i], roots.high[s, i] = _knot(chart, k), _knot(chart, k + 1)
                    roots.below[s, i], roots.above[s, i] = values[k, i], values[k + 1, i]
                    number[i] = s + 1
                    most = max(most, s + 1)
    coefficients = matrix(DEGREE + 1, LANES)
    for s in range(most):
        _polish(p, s, roots, coefficients)
    return most


@inner
def _knot(chart: int, k: int) -> Any:
    """A place of the grid: from -1 to 1 in chart 0, back in chart 1."""
    return k / 16.0 - 1.0 if chart == 0 else 1.0 - k / 16.0


@inner
def _value(p: Array, far: bool, x: float) -> Any:
    """The polynomials, of which the second chart has the coefficients in the other order, at a place."""
    value = load(p, DEGREE if far else 0)
    for d in range(1, DEGREE + 1):
        value = load(p, DEGREE - d if far else d) + value * x
    return value


@inner
def _polish(p: Array, s: int, roots: Any, c: Array) -> None:
    """A row of roots between places of different sign: Newton's method, or bisection -> z."""
    far, low, high = load(roots.far, s), load(roots.low, s), load(roots.high, s)
    below, above = load(roots.below, s), load(roots.above, s)
    for d in range(DEGREE + 1):
        store(c, d, where(far, load(p, DEGREE - d), load(p, d)))
    z = low - below * (high - low) / (above - below)
    for _ in range(POLISHING_STEPS):
        slope, value = load(c, 0), load(c, 1) + load(c, 0) * z
        for d in range(2, DEGREE + 1):
            slope = value + slope * z
            value = load(c, d) + value * z
        crossed = (value < 0.0) ^ (below < 0.0)
        low, high = where(crossed, low, z), where(crossed, z, high)
        x, a, b = z - value / slope, where(low < high, low, high), where(low < high, high, low)
        z = where((a <= x) & (x <= b), x, (low + high) / 2.0)
    store(roots.z, s, z)

"""Homographies of four matches each, compiled: the samples of one pair, LANES at a time, float64, models in float32.

With the fourth match at the origin of both images and ``D_i`` twice the signed area of the triangle that the fourth
point makes with the other two, the point ``a_4`` is a multiple of ``sum D_i a_i``, so that

    H = sum_i (E_i / D_i) b_i (a_j x a_k)^T,   a_i, b_i homogeneous, E_i the areas in image 1, (i, j, k) cyclic

maps each a_i to a multiple of b_i: the map between two projective bases (Hartley & Zisserman 2004, section 2.3 and
exercise 2.10.xv). Its last column is (0, 0, E_1 + E_2 + E_3).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, F4x2, F8x2, I8x1, I8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, absolute, fill, load, sqrt, store, where
from fmtorch.compiling.scratch import matrix
from fmtorch.geometry.nullspace_kernels import gather
from fmtorch.geometry.rank2_kernels import EPS

ROUNDING = 16 * EPS  # of the area of three points on a line, relative to their coordinates and distances
SIZE = 4


@kernel
def four_point(points: F8x2, sample: I8x2, H: F4x2, draw: I8x1) -> int:
    """Homographies of samples (4, s) of points (4, n) -> H (s, 9), draw (s,), their samples; how many there are.

    points: rows x0, y0, x1, y1, of about unit scale. H: of unit norm, positive in the third coordinate of H x0 at the
    points of the sample. A sample gives none if three of its points lie on a line in either image, or if one of the
    four triangles is turned over between the images: then the points would lie on both sides of the plane's horizon, or
    the plane would be seen from behind.
    """
    X, h, there = matrix(4 * SIZE, LANES), matrix(9, LANES), np.empty((1, LANES), np.bool_)
    work, models = matrix(6, LANES), 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        store(there, 0, _homographies(X, work, h))
        for lane in range(min(LANES, sample.shape[1] - first)):
            if there[0, lane]:
                for q in range(9):
                    H[models, q] = h[q, lane]
                draw[models] = first + lane
                models += 1
    return models


@inner
def _homographies(X: Array, work: Array, h: Array) -> Any:
    """Of LANES samples X (16, LANES) -> h (9, LANES); a mask, which there are. work: (6, LANES)."""
    there = fill(0.0) == 0.0
    for image in range(2):
        there &= _areas(X, 2 * image, work, 3 * image)
    rows = fill(0.0)
    h00, h01, h10, h11, h20, h21 = rows, rows, rows, rows, rows, rows
    x3, y3, u3, v3 = load(X, 12), load(X, 13), load(X, 14), load(X, 15)
    E = fill(0.0)
    D = fill(0.0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        d, e = load(work, i), load(work, 3 + i)
        there &= d * e > 0.0
        ratio = e / d
        p, q = ratio * (load(X, 4 * j + 1) - load(X, 4 * k + 1)), ratio * (load(X, 4 * k) - load(X, 4 * j))
        u, v = load(X, 4 * i + 2) - u3, load(X, 4 * i + 3) - v3
        h00, h01 = h00 + u * p, h01 + u * q
        h10, h11 = h10 + v * p, h11 + v * q
        h20, h21 = h20 + p, h21 + q
        D, E = D + d, E + e
    there &= D * E > 0.0
    # From where the fourth match is the origin to where it was; positive at the fourth point of image 0.
    h00, h01, h10, h11 = h00 + u3 * h20, h01 + u3 * h21, h10 + v3 * h20, h11 + v3 * h21
    h02, h12, h22 = u3 * E - h00 * x3 - h01 * y3, v3 * E - h10 * x3 - h11 * y3, E - h20 * x3 - h21 * y3
    size = sqrt(
        h00 * h00 + h01 * h01 + h02 * h02 + h10 * h10 + h11 * h11 + h12 * h12 + h20 * h20 + h21 * h21 + h22 * h22
    )
    by = 1.0 / where(E > 0.0, size, 0.0 - size)
    store(h, 0, h00 * by)
    store(h, 1, h01 * by)
    store(h, 2, h02 * by)
    store(h, 3, h10 * by)
    store(h, 4, h11 * by)
    store(h, 5, h12 * by)
    store(h, 6, h20 * by)
    store(h, 7, h21 * by)
    store(h, 8, h22 * by)
    return there & (size > 0.0) & (size < math.inf)


@inner
def _areas(X: Array, x: int, work: Array, out: int) -> Any:
    """D_1, D_2, D_3 of points X (16, LANES), whose x of the image are in row x -> rows of work from `out` on.

    A mask: whether no three of the four points lie on a line, up to rounding.
    """
    x3, y3 = load(X, 12 + x), load(X, 13 + x)
    largest = where(absolute(x3) > absolute(y3), absolute(x3), absolute(y3))
    longest, total = fill(0.0), fill(0.0)
    for i in range(3):
        j, k = 4 * ((i + 1) % 3) + x, 4 * ((i + 2) % 3) + x
        xj, yj, xk, yk = load(X, j), load(X, j + 1), load(X, k), load(X, k + 1)
        area = (xj - x3) * (yk - y3) - (xk - x3) * (yj - y3)
        store(work, out + i, area)
        total += area
        largest = where(absolute(xj) > largest, absolute(xj), largest)
        largest = where(absolute(yj) > largest, absolute(yj), largest)
        longest = where(absolute(xj - x3) > longest, absolute(xj - x3), longest)
        longest = where(absolute(yj - y3) > longest, absolute(yj - y3), longest)
    smallest = ROUNDING * largest * longest
    apart = absolute(total) > smallest
    for i in range(3):
        apart &= absolute(load(work, out + i)) > smallest
    return apart

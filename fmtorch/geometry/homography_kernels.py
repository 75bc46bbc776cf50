"""Homographies and the planes they stand for: ``x1 ~ H x0``. Matrices are (9,), row by row, points (4, n), float64.

Hartley & Zisserman (2004), Multiple View Geometry, chapters 4 and 13.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.eight_point_kernels import smallest_eigenvector
from fmtorch.geometry.rank2_kernels import EPS, unit

ROUNDING = 16 * EPS  # of cross products that should vanish, as of a match taken twice


@inner
def adjugate(H: Array, A: Array) -> None:
    """A multiple of the inverse of H -> A: the transposed cofactors."""
    A[0], A[1], A[2] = H[4] * H[8] - H[5] * H[7], H[7] * H[2] - H[8] * H[1], H[1] * H[5] - H[2] * H[4]
    A[3], A[4], A[5] = H[5] * H[6] - H[3] * H[8], H[8] * H[0] - H[6] * H[2], H[2] * H[3] - H[0] * H[5]
    A[6], A[7], A[8] = H[3] * H[7] - H[4] * H[6], H[6] * H[1] - H[7] * H[0], H[0] * H[4] - H[1] * H[3]


@inner
def maps(H: Array, x: float, y: float, u: float, v: float, limit: float) -> Any:
    """Whether H maps (x, y) to within a squared distance of (u, v)."""
    depth = H[6] * x + H[7] * y + H[8]
    du = (H[0] * x + H[1] * y + H[2]) / depth - u
    dv = (H[3] * x + H[4] * y + H[5]) / depth - v
    within: bool = du * du + dv * dv <= limit
    return within


@inner
def near_plane(H: Array, points: Array, limit: float, out: Array) -> int:
    """Which matches H and its inverse map to within a squared distance of each other -> out (n,); how many."""
    A, count = vector(9), 0
    adjugate(H, A)
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    for i in range(len(out)):
        out[i] = maps(H, x0[i], y0[i], x1[i], y1[i], limit) and maps(A, x1[i], y1[i], x0[i], y0[i], limit)
        count += out[i]
    return count


@inner
def cross_times(e: Array, A: Array, out: Array) -> None:
    """``[e]_x A`` -> out."""
    for c in range(3):
        p, q, r = A[c], A[3 + c], A[6 + c]
        out[c], out[3 + c], out[6 + c] = e[1] * r - e[2] * q, e[2] * p - e[0] * r, e[0] * q - e[1] * p


@inner
def plane_homography(F: Array, e1: Array, points: Array, triplet: Array, H: Array) -> bool:
    """The homography of the plane through the matches (3,) of a triplet that satisfy F -> H; if it is determined.

    ``H = A - e1 (M^-1 b)^T`` with ``A = [e1]_x F``, the rows of M the points in image 0, and
    ``b_i = (x1_i x (A x0_i)) . (x1_i x e1) / |x1_i x e1|^2`` (result 13.6). e1: the epipole in image 1, ``F^T e1 = 0``.
    """
    A, b, M = vector(9), vector(3), matrix(3, 3)
    cross_times(e1, F, A)
    for k in range(3):
        i = triplet[k]
        x0, y0, x1, y1 = points[0, i], points[1, i], points[2, i], points[3, i]
        M[k, 0], M[k, 1], M[k, 2] = x0, y0, 1.0
        p, q, r = A[0] * x0 + A[1] * y0 + A[2], A[3] * x0 + A[4] * y0 + A[5], A[6] * x0 + A[7] * y0 + A[8]
        cx, cy, cz = y1 * e1[2] - e1[1], e1[0] - x1 * e1[2], x1 * e1[1] - y1 * e1[0]
        length2 = cx * cx + cy * cy + cz * cz
        if not length2 > 0:
            return False
        b[k] = ((y1 * r - q) * cx + (p - x1 * r) * cy + (x1 * q - y1 * p) * cz) / length2
    determinant, v = 0.0, vector(3)
    for c in range(3):  # Cramer's rule
        d, e = (c + 1) % 3, (c + 2) % 3
        qr, rp = M[1, d] * M[2, e] - M[1, e] * M[2, d], M[2, d] * M[0, e] - M[2, e] * M[0, d]
        pq = M[0, d] * M[1, e] - M[0, e] * M[1, d]
        determinant += M[0, c] * qr
        v[c] = b[0] * qr + b[1] * rp + b[2] * pq
    if determinant == 0:
        return False
    for r in range(3):
        for c in range(3):
            H[3 * r + c] = A[3 * r + c] - e1[r] * (v[c] / determinant)
    return True


@inner
def plane_and_parallax(H: Array, points: Array, i: int, j: int, F: Array) -> bool:
    """The fundamental matrix of a plane's homography and matches i and j off it -> F, of unit norm; if there is one.

    ``F = [e1]_x H``: the lines through x1 and H x0 of both matches meet in the epipole e1 (section 13.2).
    """
    lines, e, size2 = matrix(2, 3), vector(3), 0.0
    for k in range(9):
        size2 += H[k] * H[k]
    for k in range(2):
        n = i if k == 0 else j
        x0, y0, x1, y1 = points[0, n], points[1, n], points[2, n], points[3, n]
        p, q, r = H[0] * x0 + H[1] * y0 + H[2], H[3] * x0 + H[4] * y0 + H[5], H[6] * x0 + H[7] * y0 + H[8]
        lines[k, 0], lines[k, 1], lines[k, 2] = y1 * r - q, p - x1 * r, x1 * q - y1 * p
        size2 *= lines[k, 0] * lines[k, 0] + lines[k, 1] * lines[k, 1] + lines[k, 2] * lines[k, 2]
    for c in range(3):
        d, f = (c + 1) % 3, (c + 2) % 3
        e[c] = lines[0, d] * lines[1, f] - lines[0, f] * lines[1, d]
    cross_times(e, H, F)
    norm2 = 0.0
    for k in range(9):
        norm2 += F[k] * F[k]
    if not (norm2 > ROUNDING * ROUNDING * size2 and math.isfinite(norm2)):
        return False
    norm = math.sqrt(norm2)
    for k in range(9):
        F[k] /= norm
    return True


@inner
def least_squares_homography(points: Array, weight: Array, H: Array) -> bool:
    """The normalised DLT of matches (n,) by their weights, or of those inside -> H; whether it is determined.

    Hartley & Zisserman (2004), algorithm 4.2.
    """
    T, S, M = matrix(2, 3), np.zeros((4, 3, 3)), np.zeros((9, 9))
    for image in range(2):
        if not _similarity(points[2 * image], points[2 * image + 1], weight, T[image]):
            return False
    s0, s1, h = T[0, 0], T[1, 0], np.ones(3)
    for i in range(len(weight)):
        if weight[i] > 0:
            h[0], h[1] = (points[0, i] - T[0, 1]) * s0, (points[1, i] - T[0, 2]) * s0
            x, y = (points[2, i] - T[1, 1]) * s1, (points[3, i] - T[1, 2]) * s1
            for r in range(3):
                for c in range(r, 3):
                    product = h[r] * h[c] * (1.0 * weight[i])
                    S[0, r, c] += product
                    S[1, r, c] -= x * product
                    S[2, r, c] -= y * product
                    S[3, r, c] += (x * x + y * y) * product
    for r in range(3):  # the sums of both rows that a match gives, (0, -h, y h) and (h, 0, -x h)
        for c in range(3):
            a, b = min(r, c), max(r, c)
            M[r, c] = M[3 + r, 3 + c] = S[0, a, b]
            M[r, 6 + c] = M[6 + r, c] = S[1, a, b]
            M[3 + r, 6 + c] = M[6 + r, 3 + c] = S[2, a, b]
            M[6 + r, 6 + c] = S[3, a, b]
    if not smallest_eigenvector(M, H):
        return False
    for r in range(3):  # H T0
        H[3 * r], H[3 * r + 1] = H[3 * r] * s0, H[3 * r + 1] * s0
        H[3 * r + 2] -= H[3 * r] * T[0, 1] + H[3 * r + 1] * T[0, 2]
    for c in range(3):  # the adjugate of T1, times that
        last = s1 * s1 * H[6 + c]
        H[c], H[3 + c], H[6 + c] = s1 * H[c] + T[1, 1] * last, s1 * H[3 + c] + T[1, 2] * last, last
    return True


@inner
def _similarity(x: Array, y: Array, weight: Array, out: Array) -> bool:
    """Scale and centre of the points of weight, as of `normalize_points` -> out (3,); False where there are none."""
    count, cx, cy, distance = 0, 0.0, 0.0, 0.0
    for i in range(len(weight)):
        if weight[i] > 0:
            count += 1
            cx += x[i]
            cy += y[i]
    if count == 0:
        return False
    cx, cy = cx / count, cy / count
    for i in range(len(weight)):
        if weight[i] > 0:
            distance += math.sqrt((x[i] - cx) * (x[i] - cx) + (y[i] - cy) * (y[i] - cy))
    distance /= count
    out[0] = 2**0.5 / distance if distance > 4 * EPS * max(abs(cx), abs(cy)) else 1.0
    out[1], out[2] = cx, cy
    return True


@kernel
def weighted_homography(points: F8x2, weight: F8x1, H: F8x1) -> bool:
    """`least_squares_homography`, positive at most of the weight -> H (9,); whether it is determined."""
    if not least_squares_homography(points, weight, H):
        return False
    front, total = 0.0, 0.0
    for i in range(len(weight)):
        total += weight[i]
        front += weight[i] if H[6] * points[0, i] + H[7] * points[1, i] + H[8] > 0 else 0.0
    for q in range(9):
        H[q] = -H[q] if 2 * front < total else H[q]
    unit(H)
    return True

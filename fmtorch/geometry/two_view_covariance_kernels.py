"""`two_view_covariance` of one pair, compiled: the same steps in float64; results agree to rounding."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.two_view_information_kernels import (
    PARAMETERS,
    add_information,
    distance,
    kept_share,
    noise_of,
    tangents,
)

ROTATION, DIRECTION, FOCAL = 1.33, 1.21, 2.3  # as in `two_view_posterior.DIFFUSE`
TANGENT, OF_F, NOISE, VALID, COLUMNS = 49, 55, 136, 137, 138  # where they stand in the result, behind the covariance


class Matches(NamedTuple):
    """x0, x1 (n, 2) px, which are real, mask (n,); weight and relative noise (n,), empty where they are one."""

    x0: F8x2
    x1: F8x2
    mask: B1x1
    weight: F8x1
    noise: F8x1


class Cameras(NamedTuple):
    """R (3, 3), t (3,), focal (2,), principal points (2, 2), truncation (1,) in pixels.

    precision (2, 2): of the prior on the logarithms of the focal lengths. shared (1,): whether they are one parameter.
    """

    R: F8x2
    t: F8x1
    focal: F8x1
    principal: F8x2
    truncation: F8x1
    precision: F8x2
    shared: B1x1


@kernel
def covariance_of_pair(matches: Matches, cameras: Cameras, out: F8x1) -> None:
    """Covariance (7, 7), tangent (3, 2), covariance of F (9, 9), noise and validity of a pair -> out (COLUMNS,)."""
    F, slopes, basis, free, prior = vector(9), matrix(PARAMETERS, 9), matrix(2, 3), np.ones(2), np.zeros((2, 2))
    valid = _has_meaning(cameras, free, prior)
    if valid:
        tangents(cameras.R, cameras.t, cameras.focal, F, slopes, basis)
    else:
        tangents(np.eye(3), np.array([0.0, 0.0, 1.0]), np.ones(2), F, slopes, basis)
    together = cameras.shared[0] and free[0] * free[1] > 0
    if cameras.shared[0]:
        free[0], free[1] = free[0] * free[1], 0.0
    M = _prior_information(prior, free, together, slopes)
    n = len(matches.mask) if valid else 0
    points, w, noise, r = matrix(4, n), vector(n), vector(n), vector(n)
    n = _gather(matches, cameras.principal, points, w, noise)
    for i in range(n):
        r[i] = abs(distance(F, points[0, i], points[1, i], points[2, i], points[3, i])[0]) / noise[i]
    T = cameras.truncation[0] if valid else 1.0
    s = noise_of(r[:n], w, T, 5 + free[0] + free[1])
    from_noise, C = np.zeros((2, 2)), matrix(PARAMETERS, PARAMETERS)
    scale, total, squares = kept_share(T / s), 0.0, 0.0
    for i in range(n):
        total += w[i] if r[i] < T else 0.0
        squares += w[i] * w[i] if r[i] < T else 0.0
    for i in range(n):
        if r[i] < T:
            x, y, u, v = points[0, i], points[1, i], points[2, i], points[3, i]
            add_information(F, slopes, x, y, u, v, w[i] * scale * total / squares, s * noise[i], M, from_noise)
    _invert(M, C)
    _remove(C, from_noise)
    _write(C, together, basis, out)
    _of_fundamental(C, F, slopes, cameras.principal, valid, out[OF_F:NOISE])
    out[NOISE], out[VALID] = s, valid


@inner
def _has_meaning(cameras: Cameras, free: Array, prior: Array) -> bool:
    """Whether there are cameras; which focal lengths are not known exactly -> free (2,); the finite prior -> (2, 2)."""
    total, long = 0.0 if cameras.truncation[0] > 0 else math.nan, 0.0
    for i in range(3):
        total += 0 * cameras.t[i]
        long += abs(cameras.t[i])
        for k in range(3):
            total += 0 * cameras.R[i, k]
    for i in range(2):
        free[i] = 0.0 if cameras.precision[i, i] == math.inf else 1.0
        total += 0 * (cameras.focal[i] + cameras.principal[0, i] + cameras.principal[1, i])
    for i in range(2):
        for k in range(2):
            prior[i, k] = cameras.precision[i, k] if free[i] * free[k] > 0 else 0.0
            total += 0 * prior[i, k]
    valid: bool = total == 0 and long > 0 and cameras.focal[0] > 0 and cameras.focal[1] > 0
    if not valid:
        prior[:, :] = 0.0
    return valid


@inner
def _prior_information(prior: Array, free: Array, together: bool, slopes: Array) -> Array:
    """Information (7, 7) beside that of matches; slopes (7, 9) of a shared focal length joined, of known ones zero."""
    M, a, b, c = np.zeros((PARAMETERS, PARAMETERS)), prior[0, 0], (prior[0, 1] + prior[1, 0]) / 2, prior[1, 1]
    for k in range(5):
        M[k, k] = 1 / (ROTATION * ROTATION) if k < 3 else 1 / (DIRECTION * DIRECTION)
    a, b, c = _positive(a, b, c)
    floor = 1 / (FOCAL * FOCAL)
    M[5, 5], M[5, 6], M[6, 5], M[6, 6] = a + floor, b, b, c + floor
    if together:
        M[5, 5] = a + 2 * b + c + 2 * floor
        for q in range(9):
            slopes[5, q] += slopes[6, q]
    for k in range(2):
        if free[k] == 0:
            for q in range(9):
                slopes[5 + k, q] = 0.0
            M[5, 6], M[6, 5], M[5 + k, 5 + k] = 0.0, 0.0, math.inf
    return M


@inner
def _gather(matches: Matches, principal: Array, points: Array, w: Array, noise: Array) -> int:
    """The real matches, centred -> points (4, n), their weights and noise (n,); how many."""
    count, limit = 0, points.shape[1]
    for i in range(limit):
        weight = matches.weight[i] if len(matches.weight) else 1.0
        relative = matches.noise[i] if len(matches.noise) else 1.0
        x, y, u, v = matches.x0[i, 0], matches.x0[i, 1], matches.x1[i, 0], matches.x1[i, 1]
        if matches.mask[i] and weight > 0 and relative > 0 and math.isfinite(weight + relative + x + y + u + v):
            points[0, count], points[1, count] = x - principal[0, 0], y - principal[0, 1]
            points[2, count], points[3, count] = u - principal[1, 0], v - principal[1, 1]
            w[count], noise[count] = weight, relative
            count += 1
    return count


@inner
def _invert(M: Array, C: Array) -> None:
    """The inverse of a positive definite matrix by its lower triangle, in place by Gauss and Jordan -> C (7, 7).

    Rows of infinite information are zero.
    """
    known = vector(PARAMETERS)
    for k in range(PARAMETERS):
        known[k] = M[k, k] == math.inf
        for j in range(PARAMETERS):
            C[k, j] = M[max(k, j), min(k, j)]
    for k in range(PARAMETERS):
        if known[k] > 0:
            C[k], C[:, k] = 0.0, 0.0
    for k in range(PARAMETERS):
        if known[k] > 0:
            continue
        pivot = C[k, k]
        C[k, k] = 1.0
        for j in range(PARAMETERS):
            C[k, j] /= pivot
        for i in range(PARAMETERS):
            if i != k:
                factor = C[i, k]
                C[i, k] = 0.0
                for j in range(PARAMETERS):
                    C[i, j] -= factor * C[k, j]


@inner
def _positive(a: float, b: float, c: float) -> tuple[float, float, float]:
    """The matrix [a, b; b, c] with its negative eigenvalues set to zero."""
    mean, half = (a + c) / 2, (a - c) / 2
    radius = math.sqrt(half * half + b * b)
    high, low = max(mean + radius, 0.0), max(mean - radius, 0.0)
    middle, part = (high + low) / 2, (high - low) / 2 / radius if radius > 0 else 0.0
    return middle + part * half, part * b, middle - part * half


@inner
def _remove(C: Array, noise: Array) -> None:
    """Takes information (2, 2) about the direction of translation away from a covariance, in place."""
    a, b, c, floor = C[3, 3], C[3, 4], C[4, 4], 1 / (DIRECTION * DIRECTION)
    area = a * c - b * b
    p, q, r = c / area, -b / area, a / area
    u, v, w = _positive(p - noise[0, 0] - floor, q - (noise[0, 1] + noise[1, 0]) / 2, r - noise[1, 1] - floor)
    u, w = u + floor, w + floor
    area = u * w - v * v
    da, db, dc = w / area - a, -v / area - b, u / area - c
    by = matrix(PARAMETERS, 2)
    for k in range(PARAMETERS):
        by[k, 0], by[k, 1] = C[k, 3] * p + C[k, 4] * q, C[k, 3] * q + C[k, 4] * r
    for k in range(PARAMETERS):
        for j in range(PARAMETERS):
            first, second = da * by[j, 0] + db * by[j, 1], db * by[j, 0] + dc * by[j, 1]
            C[k, j] += by[k, 0] * first + by[k, 1] * second


@inner
def _write(C: Array, together: bool, basis: Array, out: Array) -> None:
    """The covariance, in which a shared focal length stands for both, and the tangents (3, 2) -> out."""
    for k in range(PARAMETERS):
        for j in range(PARAMETERS):
            row, column = (5 if together and k == 6 else k), (5 if together and j == 6 else j)
            out[PARAMETERS * k + j] = (C[row, column] + C[column, row]) / 2
    for i in range(3):
        out[TANGENT + 2 * i], out[TANGENT + 2 * i + 1] = basis[0, i], basis[1, i]


@inner
def _of_fundamental(C: Array, F: Array, slopes: Array, principal: Array, valid: bool, out: Array) -> None:
    """The covariance of F in pixels, at unit norm -> out (81,)."""
    J, f = matrix(PARAMETERS + 1, 9), vector(9)
    x, y, u, v = 0.0, 0.0, 0.0, 0.0
    if valid:
        x, y, u, v = principal[0, 0], principal[0, 1], principal[1, 0], principal[1, 1]
    for k in range(PARAMETERS + 1):
        for q in range(9):
            f[q] = slopes[k, q] if k < PARAMETERS else F[q]
        for i in range(3):
            f[3 * i + 2] -= f[3 * i] * x + f[3 * i + 1] * y
        for c in range(3):
            f[6 + c] -= f[c] * u + f[3 + c] * v
        for q in range(9):
            J[k, q] = f[q]
    norm = 0.0
    for q in range(9):
        norm += f[q] * f[q]
    norm = math.sqrt(norm)
    for k in range(PARAMETERS):
        along = 0.0
        for q in range(9):
            along += J[k, q] * f[q] / (norm * norm)
        for q in range(9):
            J[k, q] = (J[k, q] - along * f[q]) / norm
    for p in range(9):
        for k in range(PARAMETERS):
            f[k] = 0.0
            for j in range(PARAMETERS):
                f[k] += C[k, j] * J[j, p]
        for q in range(9):
            total = 0.0
            for k in range(PARAMETERS):
                total += J[k, q] * f[k]
            out[9 * p + q] = total

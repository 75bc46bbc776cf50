"""Least-squares matching of one window, sample by sample, from the definition."""

import math
from typing import NamedTuple

import numpy as np

DAMPING, CONVERGED, MIN_CONTRAST, PITCH = 1e-3, 0.01, 0.5, 3.0


class Match(NamedTuple):
    """A refined match: point, affine map, covariance of the point, correlation."""

    x1: np.ndarray
    affine: np.ndarray
    covariance: np.ndarray
    correlation: float


def sample(image: np.ndarray, x: float, y: float) -> tuple[float, float, float] | None:
    """Grey level of an image between its pixels and its derivatives in x and y, bilinear; None outside."""
    h, w = image.shape
    if not (0 <= x < w - 1 and 0 <= y < h - 1):
        return None
    i, j = math.floor(y), math.floor(x)
    v, u = y - i, x - j
    (p, q), (r, s) = image[i : i + 2, j : j + 2].astype(float)
    value = (1 - v) * ((1 - u) * p + u * q) + v * ((1 - u) * r + u * s)
    return value, (1 - v) * (q - p) + v * (s - r), (1 - u) * (r - p) + u * (s - q)


def level_for(levels: list[np.ndarray], spacing: float) -> int:
    """The first level with samples less than `PITCH` of its pixels apart, else the last."""
    return next((k for k in range(len(levels)) if spacing / 2**k < PITCH), len(levels) - 1)


def neighbour_map(x0: np.ndarray, x1: np.ndarray, i: int) -> np.ndarray | None:
    """The similarity (2, 2) on which most of the 16 nearest neighbours of match i agree, of those fitted to it."""
    order = sorted(range(len(x0)), key=lambda j: (((x0[j] - x0[i]) ** 2).sum(), j))[:17]
    d0, d1 = ((x[order] - x[i]) @ [1, 1j] for x in (x0, x1))
    d0, d1 = d0[abs(d0) > 0], d1[abs(d0) > 0]
    supports = [abs(s * d0 - d1) <= 0.15 * abs(s * d0) + 1 for s in d1 / d0]
    best = max(supports, key=sum, default=np.zeros(0, bool))
    if best.sum() < 3:
        return None
    s = np.vdot(d0[best], d1[best]) / np.vdot(d0[best], d0[best]).real
    return np.array([[s.real, -s.imag], [s.imag, s.real]])


def refined(
    levels0: list[np.ndarray], levels1: list[np.ndarray], x0: np.ndarray, x1: np.ndarray, affine: np.ndarray,
    spacing: float, radius: int, iterations: int,
) -> tuple[float, Match] | None:  # fmt: skip
    """The correlation at the start, and the match where it is highest; None where the window cannot be fitted.
    Parameters: offset, gain, then gain times the map's four entries and the shift, in steps of image 0."""
    k0 = level_for(levels0, spacing)
    k1 = level_for(levels1, spacing * math.sqrt(abs(np.linalg.det(affine))))
    grid = np.array([(u, v) for v in range(-radius, radius + 1) for u in range(-radius, radius + 1)], float)
    w = (1 + (grid**2).sum(1) / (2 * (0.8 * radius) ** 2) / 8) ** -8.0
    w /= w.sum()
    rows = []
    for u, v in grid:
        sampled = sample(levels0[k0], *(x0 + spacing * np.array([u, v])) / 2**k0)
        if sampled is None:
            return None
        value, gx, gy = sampled[0], sampled[1] * spacing / 2**k0, sampled[2] * spacing / 2**k0
        rows.append([1, value, gx * u, gx * v, gy * u, gy * v, gx, gy])
    J = np.array(rows)
    mean = w @ J[:, 1]
    if math.sqrt(w @ (J[:, 1] - mean) ** 2) <= MIN_CONTRAST:
        return None
    N = J.T @ (w[:, None] * J)
    N[range(2, 8), range(2, 8)] *= 1 + DAMPING
    point, M = x1 / 2**k1, affine * spacing / 2**k1
    first, best, short = None, None, False
    for iteration in range(iterations + 1):
        corners = np.array([(u, v) for u in (-radius, radius) for v in (-radius, radius)]) @ M.T + point
        low, high = corners.min(0), corners.max(0)
        if sample(levels1[k1], *low) is None or sample(levels1[k1], *high) is None:
            break
        samples = [sample(levels1[k1], *(point + M @ g)) for g in grid]
        V = np.array([value[0] for value in samples if value is not None])
        T, dV = J[:, 1] - mean, V - w @ V
        correlation = (w @ (T * dV)) / math.sqrt(w @ T**2) / max(math.sqrt(w @ dV**2), MIN_CONTRAST)
        b = J.T @ (w * V)
        p = np.linalg.solve(N, b)
        if best is None or correlation > best.correlation:
            gain = (w @ (T * dV)) / (w @ T**2)
            variance = max(w @ V**2 - b @ p, 0) / gain**2 * (w @ w)
            to_pixels = M * 2**k1
            covariance = variance * to_pixels @ np.linalg.inv(N)[6:, 6:] @ to_pixels.T
            best = Match(point * 2**k1, to_pixels / spacing, covariance, correlation)
        first = correlation if iteration == 0 else first
        B, d = np.eye(2) + p[2:6].reshape(2, 2) / p[1], p[6:] / p[1]
        if p[1] <= 0 or not 1 / 4 < np.linalg.det(B) < 4 or short:
            break
        M = M @ np.linalg.inv(B)
        point = point - M @ d
        short = iteration > 0 and abs(d).sum() < CONVERGED
    return None if first is None or best is None else (first, best)

"""Significance, and evidence for kinds of image pairs, from the definitions, one pair at a time."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t, t

from tests.reference.homography import equations, sampson_squared
from tests.reference.solvers import epipolar_distances

FREEDOM = 3.0
START, FINEST, COARSEST = 1 / 1500, 0.1, 1 / 300  # of side, px, of side
LOSS = 3.0
Points = NDArray[np.float64]
CELLS = 64  # of a side of the grid in which places are told apart, to the diagonal of the image
SAMPLE = 7
MODELS = 3  # of a sample
MIN_CHANCE = 2.0**-13


def density(r: np.ndarray, s: float, dimensions: int, side: float) -> np.ndarray:
    """Of right matches over that of wrong ones, of Sampson distances (n,); side: of a square image as large."""
    if dimensions == 1:
        return t.pdf(r, FREEDOM, scale=s) * side / np.sqrt(2)
    law = multivariate_t(np.zeros(2), s**2 * np.eye(2), FREEDOM)
    return np.array([law.pdf([each, 0]) if np.isfinite(each) else 0.0 for each in r]) * side**2 / 2


def log_likelihood(P: np.ndarray, *densities: np.ndarray) -> tuple[float, np.ndarray]:
    """The maximum over the shares w of the components, of the sum of ``log(1 - P + P sum w d)``.
    P (n,): whether a match is right, beforehand; the first component is that of wrong ones all the same, of density
    1."""
    d = np.stack([np.ones(len(densities[0])), *densities], 1)
    w = np.full(d.shape[1], 1 / d.shape[1])
    for _ in range(20):
        q = P[:, None] * d * w / (1 - P + P * (d @ w))[:, None]
        last, w = w, (q.sum(0) + 0.5) / (q.sum() + 0.5 * len(w))
        if np.abs(w - last)[1:].max() < 1e-3:
            break
    return float(np.log(1 - P + P * (d @ w)).sum()), w


def noise(P: np.ndarray, r: np.ndarray, dimensions: int, side: float) -> float:
    """The noise of the mixture of wrong and right matches, by expectation and maximisation."""
    s, share = START * side, 0.5
    for _ in range(20):
        g = share * P * density(r, s, dimensions, side)
        total = 1 - share * P + g
        g, spare = g / total, (P * (1 - share) / total).sum()
        share = (g.sum() + 0.5) / (g.sum() + spare + 1)
        near = np.isfinite(r)
        squares = (g * r**2 * (FREEDOM + dimensions) / (FREEDOM + r**2 / s**2))[near].sum()
        last, s = s, float(np.clip(np.sqrt(squares / max(dimensions * g.sum(), 1e-9)), FINEST, COARSEST * side))
        if abs(s - last) < 0.01 * last:
            break
    return s


def plane_distances(H: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """Sampson distances (n,) of a homography, infinite behind its horizon."""
    return np.sqrt([sampson_squared(H.ravel(), match) for match in np.hstack([x0, x1])])


def whitened(H: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """The two equations of each match (n, 2) at unit noise, whose squares add up to the squared Sampson distance."""
    out = np.zeros((len(x0), 2))
    for i, match in enumerate(np.hstack([x0, x1])):
        e, J = equations(H.ravel(), match)
        out[i] = np.linalg.solve(np.linalg.cholesky(J @ J.T), e)
    return out


def rotation(
    H: np.ndarray, x0: np.ndarray, x1: np.ndarray, K0: np.ndarray, K1: np.ndarray, precision: np.ndarray, s: float,
    n: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """K1 R K0^-1 nearest to H, fitted to the matches by Geman and McClure's loss at LOSS noises; R, the prior's cost.
    precision (2, 2): of the logarithms of both focal lengths about those of K0 and K1; infinite: they are known."""
    G = np.linalg.inv(K1) @ H @ K0
    U, _, Vt = np.linalg.svd(G * np.sign(np.linalg.det(G)))
    R0 = U @ Vt
    known = np.isinf(np.diag(precision))
    free = np.flatnonzero(~known)
    P = np.where(np.isinf(precision) | known[:, None] | known[None], 0, precision)
    L = np.linalg.cholesky(P[np.ix_(free, free)]).T if len(free) else np.zeros((0, 0))

    def matrices(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        d = np.zeros(2)
        d[free] = p[3:]
        R = Rotation.from_rotvec(p[:3]).as_matrix() @ R0
        A0, A1 = (K @ np.diag([np.exp(v), np.exp(v), 1]) for K, v in zip((K0, K1), d, strict=True))
        return A1 @ R @ np.linalg.inv(A0), R

    def cost(p: np.ndarray) -> np.ndarray:
        r = whitened(matrices(p)[0], x0, x1) / s / n[:, None]
        r2 = (r**2).sum(1)
        return np.concatenate([r.ravel() / np.sqrt(1 + np.repeat(r2, 2) / LOSS**2), L @ p[3:]])

    p = least_squares(cost, np.zeros(3 + len(free)), x_scale=1e-3, xtol=1e-12, ftol=1e-12).x
    matrix, R = matrices(p)
    return matrix, R, float(0.5 * (L @ p[3:]) @ (L @ p[3:]))


def copy(r: np.ndarray, x0: np.ndarray, x1: np.ndarray, s: float, n: np.ndarray) -> np.ndarray:
    """The map x1 = a x0 + b of a copy or a crop, by reweighted least squares from distances r (n,) to a plane."""
    for _ in range(8):
        w = 1 / (1 + (r / (LOSS * s)) ** 2) ** 2 / n**2
        c0, c1 = (np.average(x, axis=0, weights=w) for x in (x0, x1))
        a = (w[:, None] * (x0 - c0) * (x1 - c1)).sum() / (w[:, None] * (x0 - c0) ** 2).sum()
        H = np.array([[a, 0, (c1 - a * c0)[0]], [0, a, (c1 - a * c0)[1]], [0, 0, 1]])
        r = plane_distances(H, x0, x1) / n
    return H


def significance(F: Points, x0: Points, x1: Points, size0: Any = None, size1: Any = None) -> float:
    """-log10 of the least number of false alarms over the numbers k of matches that may be meant.

    NFA(k) = 3 (n - 7) C(n, k) C(k, 7) alpha_k^(k - 7), alpha_k the k-th smallest chance that a point at random is as
    near its epipolar line as a match's, in the image where that is more likely. Of the matches that join one cell of
    image 0 to one cell of image 1 the median one counts, the upper one of two. Minus infinity for n < 8."""
    if len(x0) == 0:
        return -math.inf
    chances, cells = [[0.0] * len(x0)], []
    for image, (x, size) in enumerate(((x0, size0), (x1, size1))):
        low = x.min(0)
        h, w = size if size is not None else (x.max(0) - low)[::-1]
        diagonal, area = math.hypot(h, w), h * w
        if diagonal == 0:
            return -math.inf
        distances = [epipolar_distances(F, a, b)[image] for a, b in zip(x0, x1, strict=True)]
        chances.append([2 * d * diagonal / area if area > 0 else 1.0 for d in distances])
        cells.append([tuple(math.floor(v) for v in (p - low) / (diagonal / CELLS)) for p in x])
    alphas = [min(max(per_match), 1.0) for per_match in zip(*chances, strict=True)]
    groups: dict[object, list[float]] = {}
    for alpha, *cell in zip(alphas, *cells, strict=True):
        groups.setdefault(tuple(cell), []).append(alpha)
    counted = sorted(sorted(group)[len(group) // 2] for group in groups.values())
    n = len(counted)
    best = -math.inf
    for k in range(SAMPLE + 1, n + 1):
        tests = MODELS * (n - SAMPLE) * math.comb(n, k) * math.comb(k, SAMPLE)
        alpha = max(counted[k - 1], MIN_CHANCE)
        best = max(best, -math.log10(tests) - (k - SAMPLE) * math.log10(alpha))
    return best

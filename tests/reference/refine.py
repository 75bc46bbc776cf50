"""The robust Sampson optimum by another road: Bartoli and Sturm's rotations, and SciPy's optimisers."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from scipy.special import gamma, gammainc, gammaincc


def sampson(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """Signed Sampson distances (Hartley & Zisserman 2004, equation 11.9)."""
    h0 = np.c_[x0, np.ones(len(x0))]
    h1 = np.c_[x1, np.ones(len(x1))]
    line1, line0 = h0 @ F.T, h1 @ F
    return (h1 * line1).sum(1) / np.sqrt((line1[:, :2] ** 2).sum(1) + (line0[:, :2] ** 2).sum(1))


def loss(r2: np.ndarray, s2: float, kernel: str) -> np.ndarray:
    """The robust losses, point by point."""
    if kernel == "huber":
        return np.array([v if v <= s2 else 2 * np.sqrt(s2 * v) - s2 for v in r2])
    if kernel == "cauchy":
        return np.array([s2 * np.log(1 + v / s2) for v in r2])
    if kernel == "geman_mcclure":
        return np.array([v * s2 / (v + s2) for v in r2])
    if kernel == "magsac":
        return magsac_loss(r2, s2)
    return np.array([min(v, s2) for v in r2])


def magsac_loss(r2: np.ndarray, s2: float) -> np.ndarray:
    """Barath et al. (CVPR 2020), section 3.2, for s = k sigma_max, over its slope at zero."""

    def upper(a: float, x: np.ndarray) -> np.ndarray:
        return gammaincc(a, x) * gamma(a)

    end = np.array(3.64**2 / 2)
    variance = s2 / (2 * end)
    x = np.minimum(r2, s2) / (2 * variance)
    rho = variance / 2 * gammainc(2.5, x) * gamma(2.5) + np.minimum(r2, s2) / 4 * (upper(1.5, x) - upper(1.5, end))
    slope = (gamma(1.5) - upper(1.5, end)) / 4
    return rho / slope


def optimum(
    F: np.ndarray, x0: np.ndarray, x1: np.ndarray, weight: np.ndarray, kernel: str = "truncated", scale: float = np.inf
) -> tuple[np.ndarray, float]:
    """The local minimum near F of ``sum w rho(r^2)``, and its cost; points of about unit scale."""
    U, s, Vt = np.linalg.svd(F)

    def matrix(theta: np.ndarray) -> np.ndarray:
        angle = np.arctan2(s[1], s[0]) + theta[6]
        left = U @ Rotation.from_rotvec(theta[:3]).as_matrix()
        right = Vt.T @ Rotation.from_rotvec(theta[3:6]).as_matrix()
        return left @ np.diag([np.cos(angle), np.sin(angle), 0]) @ right.T

    def cost(theta: np.ndarray) -> float:
        return float((weight * loss(sampson(matrix(theta), x0, x1) ** 2, scale**2, kernel)).sum())

    theta = np.zeros(7)
    if np.isinf(scale):
        fit = least_squares(
            lambda t: np.sqrt(weight) * sampson(matrix(t), x0, x1), theta, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        theta = fit.x
    else:
        for _ in range(3):
            theta = minimize(cost, theta, method="BFGS", options={"gtol": 1e-14, "maxiter": 500}).x
    return matrix(theta), cost(theta)

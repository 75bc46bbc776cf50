"""The robust Sampson optimum by another road: Bartoli and Sturm's rotations, and SciPy's optimisers."""

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import gamma, gammainc, gammaincc

from fmtorch.geometry import LOSSES
from fmtorch.geometry.levenberg_marquardt import LOSS_TABLE
from tests.reference.solvers import Array, sampson


def loss(r2: np.ndarray, s2: float | np.ndarray, name: str) -> np.ndarray:
    """The robust losses of squared residuals, which may be complex but for MAGSAC++, and of squared scales."""
    if name == "cauchy":
        return np.asarray(s2 * np.log1p(r2 / s2))
    if name == "geman_mcclure":
        return np.asarray(r2 * s2 / (r2 + s2))
    if name == "magsac":
        return magsac_loss(r2, s2)
    return np.where(r2.real <= s2, r2, s2 if name == "truncated" else 2 * np.sqrt(s2 * r2) - s2)


def magsac_loss(r2: np.ndarray, s2: float | np.ndarray) -> np.ndarray:
    """Barath et al. (CVPR 2020), section 3.2, for s = k sigma_max, over its slope at zero."""

    def upper(a: float, x: np.ndarray) -> np.ndarray:
        return gammaincc(a, x) * gamma(a)

    end = np.array(3.64**2 / 2)
    variance = s2 / (2 * end)
    x = np.minimum(r2, s2) / (2 * variance)
    rho = variance / 2 * gammainc(2.5, x) * gamma(2.5) + np.minimum(r2, s2) / 4 * (upper(1.5, x) - upper(1.5, end))
    slope = (gamma(1.5) - upper(1.5, end)) / 4
    return rho / slope


def optimum(F: Array, x0: Array, x1: Array, weight: Array, name: str, scale: float) -> tuple[Array, float]:
    """The local minimum near F of ``sum w rho(r^2)``, and its cost; points of about unit scale."""
    U, s, Vt = np.linalg.svd(F)

    def matrix(theta: np.ndarray) -> np.ndarray:
        angle = np.arctan2(s[1], s[0]) + theta[6]
        left = U @ Rotation.from_rotvec(theta[:3]).as_matrix()
        right = Vt.T @ Rotation.from_rotvec(theta[3:6]).as_matrix()
        return left @ np.diag([np.cos(angle), np.sin(angle), 0]) @ right.T

    def cost(theta: np.ndarray) -> float:
        return float((weight * loss(sampson(matrix(theta), x0, x1) ** 2, scale**2, name)).sum())

    theta = np.zeros(7)
    for _ in range(3):
        theta = minimize(cost, theta, method="BFGS", options={"gtol": 1e-14, "maxiter": 500}).x
    return matrix(theta), cost(theta)


def tabulated(r2: np.ndarray, s2: np.ndarray) -> np.ndarray:
    """MAGSAC++'s loss by the table of its weights, which are linear between entries."""
    entries = LOSS_TABLE.shape[1] - 2
    share, interval = np.modf(np.minimum(r2 / s2, 1) * entries)
    weight, following = (LOSS_TABLE[0, interval.astype(int) + k] for k in (0, 1))
    inside = (weight + share * (following - weight) / 2) * share / entries
    return np.asarray(s2 * (LOSS_TABLE[1, interval.astype(int)] + inside))


def normal_equations(f: Array, points: Array, weight: Array, s2: Array, name: str) -> tuple[Array, float]:
    """``[J r]^T W [J r]`` (10, 10) of a model (9,), by the derivative of the residual, and the cost; points (4, n)."""
    x0, x1 = points[:2].T, points[2:].T
    h0, h1 = np.c_[x0, np.ones(len(x0))], np.c_[x1, np.ones(len(x1))]
    F = f.reshape(3, 3)
    line1, line0 = h0 @ F.T, h1 @ F
    e, g2 = (h1 * line1).sum(1), (line1[:, :2] ** 2).sum(1) + (line0[:, :2] ** 2).sum(1)
    rows = []
    for match in range(len(x0)):
        for_e = np.outer(h1[match], h0[match])
        for_g2 = 2 * np.outer(line1[match] * [1, 1, 0], h0[match]) + 2 * np.outer(h1[match], line0[match] * [1, 1, 0])
        slope = for_e / np.sqrt(g2[match]) - e[match] * for_g2 / (2 * g2[match] ** 1.5)
        rows.append(np.append(slope.ravel(), e[match] / np.sqrt(g2[match])))
    A = np.array(rows)
    r2 = e**2 / g2
    slope = LOSSES[name].weight(torch.from_numpy(r2), torch.from_numpy(s2)).numpy()
    values = tabulated(r2, s2) if name == "magsac" else loss(r2, s2, name)
    return A.T @ (A * (weight * slope)[:, None]), float(weight @ values)


def levenberg_marquardt(
    f: Array, points: Array, weight: Array, s2: Array, name: str, iterations: int, damping: float, tolerance: float
) -> tuple[Array, float]:
    """The model (9,) and its cost after damped steps across F and ``e1 e0^T``, each made rank 2 along the second."""
    U, s, Vt = np.linalg.svd(f.reshape(3, 3))
    F = U @ np.diag([s[0], s[1], 0]) @ Vt / np.hypot(s[0], s[1])
    products, cost = normal_equations(F.ravel(), points, weight, s2, name)
    for _ in range(iterations):
        U, _, Vt = np.linalg.svd(F)
        normal = np.outer(U[:, 2], Vt[2])
        frame = np.linalg.svd(np.stack([F.ravel(), normal.ravel()]))[2][2:]  # (7, 9), an orthonormal tangent basis
        H = frame @ (products[:9, :9] + damping * products[:9, :9].diagonal().max() * np.eye(9)) @ frame.T
        G = F - (frame.T @ np.linalg.solve(H, frame @ products[:9, 9])).reshape(3, 3)
        cofactors = np.stack([np.cross(G[1], G[2]), np.cross(G[2], G[0]), np.cross(G[0], G[1])])
        G = G - np.linalg.det(G) / (cofactors * normal).sum() * normal
        G /= np.linalg.norm(G)
        trial, trial_cost = normal_equations(G.ravel(), points, weight, s2, name)
        better, gain = trial_cost < cost, cost - trial_cost
        damping = min(max(damping / 10 if better else damping * 10, 1e-12), 1e6)
        if better:
            done = gain <= tolerance * cost and tolerance > 0
            F, products, cost = G, trial, trial_cost
            if done:
                break
    return F.ravel(), cost

"""Homographies of samples and of all matches, parallax and Sampson errors, one problem at a time, by NumPy's SVD.

H may be complex, so derivatives are exact: that of f by h along v is ``Im f(h + i t v) / t`` for a tiny t."""

from collections.abc import Callable
from typing import cast

import numpy as np

from tests.reference.refine import loss as robust_loss
from tests.reference.solvers import hartley, homogeneous, skew, unit

STEP = 1e-30  # of complex derivatives


def dlt(x0: np.ndarray, x1: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The normalised direct linear transform (Hartley & Zisserman 2004, algorithm 4.2)."""
    w = np.ones(len(x0)) if weight is None else weight
    T0, T1 = hartley(x0, w), hartley(x1, w)
    rows = []
    for a, b, s in zip(homogeneous(x0) @ T0.T, homogeneous(x1) @ T1.T, np.sqrt(w), strict=True):
        rows.append(s * np.concatenate([np.zeros(3), -a, b[1] * a]))
        rows.append(s * np.concatenate([a, np.zeros(3), -b[0] * a]))
    H = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    return unit(np.linalg.inv(T1) @ H @ T0)


def transfer(H: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """The greater of the distances (n,) from H x0 to x1 and from H^-1 x1 to x0."""
    ends = mapped(H, x0) - x1, mapped(np.linalg.inv(H), x1) - x0
    return np.asarray(np.linalg.norm(ends, axis=2).max(0))


def through_plane(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """The homography of three matches that satisfy F: the DLT of these and the epipoles, which correspond (13.1)."""
    U, _, Vt = np.linalg.svd(F)
    rows = []
    for a, b in [*zip(homogeneous(x0), homogeneous(x1), strict=True), (Vt[2], U[:, 2])]:
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        rows.append(np.kron(skew(b), a))  # [b]_x H a = 0
    return unit(np.linalg.svd(np.vstack(rows))[2][-1].reshape(3, 3))


def plane_and_parallax(H: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """[e1]_x H with e1 where the lines through x1 and H x0 of two matches meet."""
    lines = [np.cross(b, H @ a) for a, b in zip(homogeneous(x0), homogeneous(x1), strict=True)]
    e = np.cross(lines[0], lines[1])
    return unit(skew(e) @ H)


def equations(h: np.ndarray, match: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``e = (X - u W, Y - v W)`` of a match x, y, u, v, (X, Y, W) = H (x, y, 1), and its Jacobian (2, 4) by these.
    Two of the three equations ``x1 x (H x0) = 0`` of Chum, Pajdla and Sturm (2005), section 3."""
    H, (x, y, u, v) = h.reshape(3, 3), match
    X, Y, W = H @ np.array([x, y, 1.0])
    by_x0 = np.array([H[0, :2] - u * H[2, :2], H[1, :2] - v * H[2, :2]])
    return np.array([X - u * W, Y - v * W]), np.hstack([by_x0, -W * np.eye(2)])


def sampson_squared(h: np.ndarray, match: np.ndarray) -> complex:
    """``e^T (J J^T)^-1 e``, the squared length of the least correction ``-J^T (J J^T)^-1 e`` to first order."""
    if (h.reshape(3, 3)[2] @ np.array([match[0], match[1], 1.0])).real <= 0:
        return np.inf
    e, J = equations(h, match)
    return cast(complex, e @ np.linalg.solve(J @ J.T, e))


def robust_sum(h: np.ndarray, points: np.ndarray, weight: np.ndarray, s2: np.ndarray, loss: str) -> complex:
    """``sum_i w_i rho(r_i^2)`` over matches (4, n) of positive weight."""
    counted = weight > 0
    r2 = np.array([sampson_squared(h, match) for match in points.T[counted]])
    return (weight[counted] * robust_loss(r2, s2[counted], loss)).sum()


def gradient(f: Callable[[np.ndarray], complex], h: np.ndarray) -> np.ndarray:
    return np.array([np.imag(f(h + 1j * STEP * v)) / STEP for v in np.eye(9)])


def gauss_newton(h: np.ndarray, points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """``sum_i w_i G^T (J J^T)^-1 G`` (9, 9), G the derivative of ``e + J d`` with d, the correction, held."""
    total = np.zeros((9, 9))
    for match, w in zip(points.T, weight, strict=True):
        e, J = equations(h, match)
        d = -J.T @ np.linalg.solve(J @ J.T, e)
        moved = [equations(h + 1j * STEP * v, match) for v in np.eye(9)]
        G = np.stack([(a + B @ d).imag / STEP for a, B in moved], 1)
        total += w * G.T @ np.linalg.solve(J @ J.T, G)
    return total


def mapped(h: np.ndarray, x: np.ndarray) -> np.ndarray:
    y = homogeneous(x) @ h.reshape(3, 3).T
    return np.asarray(y[:, :2] / y[:, 2:])


def four_points(match: np.ndarray) -> tuple[np.ndarray | None, float]:
    """H (9,) of matches (4, 4), one a column, and how many roundings of its equations an entry of it may be off.
    The DLT by SVD, positive where the first point is seen. None if it maps a point of the sample to the other side of
    the horizon, or turns the plane over. In general position it is unique; see `collinear`."""
    rows = []
    for x, y, u, v in match.T:
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    _, values, Vt = np.linalg.svd(np.array(rows))
    depth = homogeneous(match[:2].T) @ Vt[8, 6:]
    h = Vt[8] * np.sign(depth[0])
    seen = (depth * depth[0] > 0).all() and np.linalg.det(h.reshape(3, 3)) > 0
    return h if seen else None, float(values[0] / values[7])

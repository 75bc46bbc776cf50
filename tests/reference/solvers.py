"""Epipolar geometry and minimal solvers from the definitions, one problem at a time, by NumPy's SVD and roots."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def homogeneous(x: Array) -> Array:
    return np.column_stack([x, np.ones(len(x))])


def hartley(x: Array, w: Array | None = None) -> Array:
    """T: (weighted) centroid to the origin, mean distance to sqrt 2."""
    w = np.ones(len(x)) if w is None else w
    c = (w[:, None] * x).sum(0) / w.sum()
    s = np.sqrt(2) / ((w * np.linalg.norm(x - c, axis=1)).sum() / w.sum())
    return np.array([[s, 0, -s * c[0]], [0, s, -s * c[1]], [0, 0, 1]])


def skew(e: Array) -> Array:
    return np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])


def unit(F: Array) -> Array:
    F = F / np.linalg.norm(F)
    return F * np.sign(F.flat[np.abs(F).argmax()])


def rank2(F: Array) -> Array:
    U, S, Vt = np.linalg.svd(F)
    return U @ np.diag([S[0], S[1], 0]) @ Vt


def equations(x0: Array, x1: Array) -> Array:
    """One row kron(x1, x0) per match: row . vec(F) = x1^T F x0."""
    return np.array([np.kron(b, a) for a, b in zip(homogeneous(x0), homogeneous(x1), strict=True)])


def normalised_equations(x0: Array, x1: Array, w: Array | None = None) -> tuple[Array, Array, Array]:
    T0, T1 = hartley(x0, w), hartley(x1, w)
    A = equations((homogeneous(x0) @ T0.T)[:, :2], (homogeneous(x1) @ T1.T)[:, :2])
    return A, T0, T1


def eight_point(x0: Array, x1: Array, w: Array | None = None) -> Array:
    A, T0, T1 = normalised_equations(x0, x1, w)
    if w is not None:
        A = np.sqrt(w)[:, None] * A
    F = np.linalg.svd(A)[2][-1].reshape(3, 3)
    return unit(T1.T @ rank2(F) @ T0)


def seven_point(x0: Array, x1: Array) -> list[Array]:
    A, T0, T1 = normalised_equations(x0, x1)
    F0, F1 = np.linalg.svd(A)[2][-2:].reshape(2, 3, 3)
    z = np.array([-1.0, -0.3, 0.4, 1.0])
    cubic = np.polyfit(z, [np.linalg.det(F0 + s * F1) for s in z], 3)
    roots = np.roots(cubic)
    return [unit(T1.T @ (F0 + r.real * F1) @ T0) for r in roots if abs(r.imag) < 1e-9 * max(1, abs(r))]


def poses(E: Array) -> list[tuple[Array, Array]]:
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations = [U @ w @ Vt for w in (W, W.T)]
    return [(R * np.linalg.det(R), sign * U[:, 2]) for R in rotations for sign in (1, -1)]


def pose(F: Array, K0: Array, K1: Array, x0: Array, x1: Array) -> tuple[Array, Array, int]:
    """Brute force: every decomposition, every point triangulated, depths counted."""
    best: tuple[Array, Array, int] | None = None
    n0 = homogeneous(x0) @ np.linalg.inv(K0).T
    n1 = homogeneous(x1) @ np.linalg.inv(K1).T
    P0 = np.eye(3, 4)
    for R, t in poses(K1.T @ F @ K0):
        P1 = np.column_stack([R, t])
        X = cv2.triangulatePoints(P0, P1, n0[:, :2].T, n1[:, :2].T)
        count = int(((X[2] / X[3] > 0) & ((P1 @ X)[2] / X[3] > 0)).sum())
        if best is None or count > best[2]:
            best = (R, t, count)
    assert best is not None
    return best


def consistently_oriented(F: Array, x0: Array, x1: Array) -> bool:
    """Whether F x0 is a multiple of e1 x x1 by factors of one sign (Chum, Werner & Matas 2004, equation 2)."""
    e1 = np.linalg.svd(F)[0][:, 2]
    signs = [np.sign(np.dot(F @ a, np.cross(e1, b))) for a, b in zip(homogeneous(x0), homogeneous(x1), strict=True)]
    return abs(sum(signs)) == len(signs)


def fundamental_from_projections(P0: np.ndarray, P1: np.ndarray) -> np.ndarray:
    """F = [P1 C]_x P1 P0^+, unit Frobenius norm, sign arbitrary."""
    centre = np.linalg.svd(P0)[2][-1]
    F = skew(P1 @ centre) @ P1 @ np.linalg.pinv(P0)
    return F / np.linalg.norm(F)


def line(F: np.ndarray, x: np.ndarray) -> np.ndarray:
    a, b, c = F @ np.array([x[0], x[1], 1.0])
    return np.array([a, b, c]) / np.hypot(a, b)


def epipolar_distances(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> tuple[float, float]:
    """Distance of x0 from the line of x1, and of x1 from the line of x0."""
    return abs(float(line(F.T, x1) @ [*x0, 1])), abs(float(line(F, x0) @ [*x1, 1]))


def sampson(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """Signed Sampson distances (n,) of matches (n, 2) (Hartley & Zisserman 2004, equation 11.9)."""
    h0, h1 = homogeneous(x0), homogeneous(x1)
    line1, line0 = h0 @ F.T, h1 @ F
    return np.asarray((h1 * line1).sum(1) / np.sqrt((line1[:, :2] ** 2).sum(1) + (line0[:, :2] ** 2).sum(1)))

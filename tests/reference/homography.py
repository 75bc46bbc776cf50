"""Homographies and plane-and-parallax from the definitions, one problem at a time, with NumPy's SVD."""

import numpy as np

from tests.reference.solvers import hartley, homogeneous, skew, unit


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


def transfer(H: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> float:
    """The greater of the distances from H x0 to x1 and from H^-1 x1 to x0."""
    there, back = H @ np.append(x0, 1), np.linalg.inv(H) @ np.append(x1, 1)
    return float(max(np.linalg.norm(there[:2] / there[2] - x1), np.linalg.norm(back[:2] / back[2] - x0)))


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

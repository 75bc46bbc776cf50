"""Two-view geometry for one pair of cameras and one match at a time, written from the definitions."""

import numpy as np

from tests.reference.solvers import skew


def fundamental_from_projections(P0: np.ndarray, P1: np.ndarray) -> np.ndarray:
    """F = [P1 C]_x P1 P0^+, unit Frobenius norm, sign arbitrary."""
    centre = np.linalg.svd(P0)[2][-1]
    F = skew(P1 @ centre) @ P1 @ np.linalg.pinv(P0)
    return F / np.linalg.norm(F)


def line(F: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The epipolar line of x with unit normal."""
    a, b, c = F @ np.array([x[0], x[1], 1.0])
    return np.array([a, b, c]) / np.hypot(a, b)


def distance(x: np.ndarray, l: np.ndarray) -> float:  # noqa: E741
    """Distance of a point from a line with unit normal."""
    return float(abs(l[0] * x[0] + l[1] * x[1] + l[2]))


def epipolar_distances(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> tuple[float, float]:
    """Distance of x0 from the line of x1, and of x1 from the line of x0."""
    return distance(x0, line(F.T, x1)), distance(x1, line(F, x0))


def sampson(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> float:
    """|e| / |grad e| with the gradient over the four coordinates of the match."""
    p0, p1 = np.array([*x0, 1.0]), np.array([*x1, 1.0])
    gradient = np.concatenate([(F.T @ p1)[:2], (F @ p0)[:2]])
    return float(abs(p1 @ F @ p0) / np.linalg.norm(gradient))

"""A two-view fit and its covariance from the definitions, one pair at a time, with numeric derivatives.

Parameters (7,) are a rotation vector that multiplies R from the left, two along unit tangents of t, and what is
added to the logarithms of both focal lengths."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Self

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from tests.reference.solvers import sampson, skew

STEP = 1e-6  # of central differences


@dataclasses.dataclass(frozen=True)
class Cameras:
    """R, t (unit), focal (2,) px, principal (2, 2) px; basis (3, 2): tangents of t."""

    R: np.ndarray
    t: np.ndarray
    focal: np.ndarray
    principal: np.ndarray
    basis: np.ndarray

    @classmethod
    def of(cls, R: np.ndarray, t: np.ndarray, focal: np.ndarray, principal: np.ndarray) -> Self:
        return cls(R, t / np.linalg.norm(t), focal, principal, null_space(t[None]))

    def moved(self, by: np.ndarray) -> Self:
        R = Rotation.from_rotvec(by[:3]).as_matrix() @ self.R
        return self.of(R, self.t + self.basis @ by[3:5], self.focal * np.exp(by[5:]), self.principal)

    def fundamental(self) -> np.ndarray:
        F = self.unscaled()
        return F / np.linalg.norm(F)

    def unscaled(self) -> np.ndarray:
        """``K1^-T [t]x R K0^-1``."""
        known = zip(self.focal, self.principal, strict=True)
        K0, K1 = (np.array([[f, 0, p[0]], [0, f, p[1]], [0, 0, 1]]) for f, p in known)
        return np.linalg.inv(K1).T @ skew(self.t) @ self.R @ np.linalg.inv(K0)


def residuals(cameras: Cameras, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    return sampson(cameras.fundamental(), x0, x1)


def normals(cameras: Cameras, x0: np.ndarray, x1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The derivatives (n, 4) of x1^T F x0 by the points at unit length, F unscaled; and their lengths (n,)."""
    a, b = (np.c_[x, np.ones(len(x))] for x in (x0, x1))
    F = cameras.unscaled()
    by_points = np.hstack([(b @ F)[:, :2], (a @ F.T)[:, :2]])
    length = np.linalg.norm(by_points, axis=1)
    return by_points / length[:, None], length


def linearised(cameras: Cameras, x0: np.ndarray, x1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (n, 7) of the distances by the parameters at the corrected points, and their noise (n, 2, 2).
    The noise is that of the derivatives by the direction of t, for points with noise of one pixel, of which the part
    along the correction is gone."""
    normal, length = normals(cameras, x0, x1)
    x = np.hstack([x0, x1]) - residuals(cameras, x0, x1)[:, None] * normal

    def algebraic(c: Cameras, x: np.ndarray) -> np.ndarray:
        a, b = (np.c_[y, np.ones(len(y))] for y in (x[:, :2], x[:, 2:]))
        return (b * (a @ c.unscaled().T)).sum(1) / length

    J = slopes(functools.partial(algebraic, x=x), cameras)
    by_point = np.zeros((len(x), 2, 4))  # in steps of a pixel: x1^T F x0 is linear in each coordinate
    for k, step in enumerate(np.eye(4)):
        there, back = (slopes(functools.partial(algebraic, x=x + d), cameras) for d in (step, -step))
        by_point[:, :, k] = (there - back)[:, 3:5] / 2
    free = np.eye(4) - normal[:, :, None] * normal[:, None]
    return J, by_point @ free @ by_point.swapaxes(1, 2)


def slopes(function: Callable[[Cameras], np.ndarray], cameras: Cameras) -> np.ndarray:
    """Derivatives (..., 7) of a function of cameras by the parameters."""
    steps = STEP * np.eye(7)
    return np.stack([(function(cameras.moved(d)) - function(cameras.moved(-d))) / (2 * STEP) for d in steps], -1)


def directions(known: np.ndarray, shared: bool) -> np.ndarray:
    """The basis (7, p) of what is estimated: pose, and focal lengths that are not known, or both as one."""
    focal = np.eye(7)[:, 5:]
    if shared:
        focal = np.zeros((7, 0)) if known.any() else focal.sum(1, keepdims=True)
    else:
        focal = focal[:, ~known]
    return np.hstack([np.eye(7)[:, :5], focal])


def left(c: float) -> float:
    """The share of a truncated fit's information, and of the variance within the limit: m / A."""
    A = norm.cdf(c) - norm.cdf(-c)
    return float((A - 2 * c * norm.pdf(c)) / A)


def noise(r: np.ndarray, w: np.ndarray, truncation: float, parameters: int) -> float:
    s = 0.6 * truncation
    for _ in range(200):
        near = (np.abs(r) < 2.5 * s) & (w > 0)
        if near.sum() < parameters + 3:
            return s
        v, share = w[near], left(2.5)
        spare = share * (v.sum() - parameters * share * (v**2).sum() / v.sum())
        s = min(max(float(np.sqrt((v * r[near] ** 2).sum() / spare)), 1e-3), truncation)
    return s


def positive_part(A: np.ndarray) -> np.ndarray:
    """A symmetric matrix with its negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(A)
    result: np.ndarray = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
    return result


def inflation(x: np.ndarray, error: np.ndarray) -> float:
    """Of the variance of sums of errors, by all pairs of them: sums over cells have those within one, over blocks of
    2 x 2 cells half of those in cells beside one another, and the root grows by as much again towards large regions."""
    x, error = x[error != 0], error[error != 0]
    cell = np.minimum((x - x.min(0)) / (np.ptp(x, 0).max() / 24), 23).astype(int)
    apart = np.abs(cell[:, None] - cell[None])
    small, large = (np.clip(1 - apart / cells, 0, None).prod(-1) for cells in (1, 2))
    roots = [np.sqrt(error @ by @ error / (error @ error)) for by in (small, large)]
    D = float(max(2 * roots[1] - roots[0], 0) ** 2)
    return D if D > 1.2 else 1.0


def covariance(
    cameras: Cameras, x0: np.ndarray, x1: np.ndarray, w: np.ndarray, n: np.ndarray, truncation: float,
    precision: np.ndarray, basis: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Of the parameters (7, 7), of F (9, 9), and the noise; basis: of `directions`; precision (2, 2): of the prior."""
    r = residuals(cameras, x0, x1) / n
    J, in_slopes = linearised(cameras, x0, x1)
    J = J / n[:, None]
    s = noise(r, w, truncation, basis.shape[1])
    v = np.where(np.abs(r) < truncation, w, 0)
    factor = left(truncation / s) * v.sum() / (v**2).sum() / inflation(x0, v * r)
    information = factor * (J.T * v) @ J / s**2
    information += np.diag(np.array([1.33, 1.33, 1.33, 1.21, 1.21, 2.3, 2.3]) ** -2.0)
    information[5:, 5:] += precision
    # Of the marginal information S about the direction of t noise is taken, which leaves T; known is T S^-1 T, and at
    # least what 1.21 radians are.
    free = basis.T @ information @ basis
    S = np.linalg.inv(np.linalg.inv(free)[3:5, 3:5])
    diffuse_information = np.eye(2) / 1.21**2
    seen = positive_part(S - diffuse_information)
    T = positive_part(seen - factor * np.einsum("n,nij->ij", v, in_slopes))
    free[3:5, 3:5] += T @ np.linalg.inv(seen + diffuse_information) @ T + diffuse_information - S
    C = basis @ np.linalg.inv(free) @ basis.T
    G = slopes(lambda c: c.fundamental().ravel(), cameras)
    return C, G @ C @ G.T, s

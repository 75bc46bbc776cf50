"""Pairs of known cameras: scenes, images of square pixels, and the pose of least error, one pair at a time."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.reference.focal import Measured, calibration
from tests.reference.solvers import sampson, skew

SIZE = (480, 640)
Sizes = tuple[tuple[int, int], tuple[int, int]]
Cameras = tuple[np.ndarray, np.ndarray]
UNMEASURED = ((1.0, np.inf), (1.0, np.inf))
K0 = np.array([[500, 2, 310], [0, 520, 250], [0, 0, 1.0]])
K1 = np.array([[600, -1, 330], [0, 590, 230], [0, 0, 1.0]])


class Scene(NamedTuple):
    """Matches (n, 2) in pixels, whether they are right, and the motion, X1 = R X0 + t."""

    x0: np.ndarray
    x1: np.ndarray
    right: np.ndarray
    R: np.ndarray
    t: np.ndarray


def scene(
    seed: int, count: int = 150, noise: float = 0.0, outliers: float = 0.3, cameras: Cameras = (K0, K1)
) -> Scene:  # fmt: skip
    """A cloud of points from two sides, all in front of both cameras."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(4, 6, count)]
    R = Rotation.from_rotvec(np.array([0.02, 0.3, 0.05]) + rng.uniform(-0.05, 0.05, 3)).as_matrix()
    t = np.array([-1.5, 0.2, 0.4]) + rng.uniform(-0.1, 0.1, 3)
    seen = zip((X, X @ R.T + t), cameras, strict=True)
    x0, x1 = ((Y / Y[:, 2:] @ K.T)[:, :2] + rng.normal(0, noise, (count, 2)) for Y, K in seen)
    right = rng.random(count) >= outliers
    x1[~right] = rng.uniform([0, 0], SIZE[::-1], ((~right).sum(), 2))
    return Scene(x0, x1, right, R, t / np.linalg.norm(t))


def square(K: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The map from pixels of K to square ones about the image centre, and their K."""
    h, w = size
    f = np.sqrt(K[0, 0] * K[1, 1])
    new = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    return new @ np.linalg.inv(K), new


def fundamental(R: np.ndarray, t: np.ndarray, cameras: Cameras = (K0, K1)) -> np.ndarray:
    """F = K1^-T [t]x R K0^-1 of unit norm."""
    F = np.linalg.inv(cameras[1]).T @ skew(t) @ R @ np.linalg.inv(cameras[0])
    return F / np.linalg.norm(F)


def fitted(s: Scene, error: Callable[..., np.ndarray], focals: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, t and so many logarithms of focal lengths of least squared errors, near the true pose."""
    a, b = np.linalg.svd(s.t[None])[2][1:]

    def unpacked(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = s.t + p[3] * a + p[4] * b
        return Rotation.from_rotvec(p[:3]).as_matrix() @ s.R, t / np.linalg.norm(t), p[5:]

    start, exact = np.r_[np.zeros(5), np.full(focals, 0.1)], {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return unpacked(least_squares(lambda p: error(*unpacked(p)), start, jac="3-point", max_nfev=1000, **exact).x)


def best_pose(s: Scene, weight: np.ndarray, cameras: Cameras = (K0, K1)) -> tuple[np.ndarray, np.ndarray]:
    """R, t of least weighted squared Sampson error in the images of square pixels, near the true ones."""
    (A0, C0), (A1, C1) = (square(K, SIZE) for K in cameras)
    x0, x1 = ((np.c_[x, np.ones(len(x))] @ A.T)[:, :2] for x, A in ((s.x0, A0), (s.x1, A1)))

    def error(R: np.ndarray, t: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(weight) * sampson(fundamental(R, t, (C0, C1)), x0, x1))

    return fitted(s, error, 0)[:2]


def angle(R: np.ndarray, S: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(R @ S.T).as_rotvec())))


def pose_error(R: np.ndarray, t: np.ndarray, s: Scene) -> float:
    """The larger of the angles of rotation and translation, degrees."""
    sine, cosine = np.linalg.norm(np.cross(t, s.t)), t @ s.t
    return max(angle(R, s.R), float(np.degrees(np.arctan2(sine, cosine))))


def best_cameras(
    s: Scene, sizes: Sizes, sigma: float, measured: Measured = UNMEASURED, shared: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, t and focal lengths (px) of greatest posterior near the true pose, of images of two sizes (h, w).
    sigma: standard deviation of Sampson distances, px. measured: focal lengths, px, and their deviations, of at least
    0.02. shared: whether both are one in units of the longer sides."""
    longest = [max(size) for size in sizes]

    def error(R: np.ndarray, t: np.ndarray, phi: np.ndarray) -> np.ndarray:
        phi = np.broadcast_to(phi, 2)
        camera0, camera1 = (calibration(np.exp(f), size) for f, size in zip(phi, sizes, strict=True))
        prior = [(phi.mean() - np.log(1.2)) / 0.4, (phi[0] - phi[1]) / 0.5]
        z = [(f - np.log(px / side)) / s for f, side, (px, s) in zip(phi, longest, measured, strict=True)]
        z2 = float(np.square(z).sum())
        prior.append(np.sqrt(6 * z2 / (z2 + 6)))  # half its square is the cost of measurements with a tail
        return np.concatenate([sampson(fundamental(R, t, (camera0, camera1)), s.x0, s.x1) / sigma, prior])

    R, t, phi = fitted(s, error, 2 - shared)
    return R, t, np.exp(np.broadcast_to(phi, 2)) * longest

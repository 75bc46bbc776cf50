"""The maximum a posteriori over pose and two focal lengths, one candidate at a time, by SciPy.

Parameters: a rotation vector, the direction of the translation and two log focal lengths; with ``K = [f 0 cx; 0 f cy;
0 0 1]`` the model is ``F = K1^-T [t]x R K0^-1``. Minimises
``sum P rho(r) / (2 sigma^2) + ((ln f0 - ln f1) / s1)^2 / 2 + ((mean ln f - ln usual) / s2)^2 / 2``, for images of one
size less ``A / (1 + (ln f0 - ln f1)^2 / s3^2)``; for each measured focal length plus ``z^2 / 2``, or
``5 z^2 / (z^2 + 10)`` where its deviation s is 0.02 or more, of ``z = (ln f - ln measured) / s``."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.reference.solvers import Array, poses, skew

Size = tuple[int, int]
Measured = tuple[tuple[float, float], tuple[float, float]]
UNMEASURED = ((0.0, np.inf), (0.0, np.inf))


def calibration(focal: float, size: Size) -> np.ndarray:
    """K of a camera with square pixels and central principal point; focal in units of the longer side, size (h, w)."""
    h, w = size
    f = focal * max(h, w)
    return np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])


def fundamental(parameters: np.ndarray, size0: Size, size1: Size) -> np.ndarray:
    """F of rotation vector (3), translation (3), log focal lengths (2)."""
    R = Rotation.from_rotvec(parameters[:3]).as_matrix()
    K0, K1 = calibration(np.exp(parameters[6]), size0), calibration(np.exp(parameters[7]), size1)
    return np.linalg.inv(K1).T @ skew(parameters[3:6]) @ R @ np.linalg.inv(K0)


def prior_cost(log_f0: float, log_f1: float, same_size: bool = False, measured: Measured = UNMEASURED) -> float:
    """What the two focal lengths cost; less where images of equal size may be of one camera.
    measured: logarithm and deviation of each; an infinite deviation is no measurement."""
    difference = log_f0 - log_f1
    well = 3 * 0.01**2 / (0.01**2 + difference**2) if same_size else 0.0
    cost = (difference / 0.5) ** 2 / 2 + (((log_f0 + log_f1) / 2 - np.log(1.2)) / 0.4) ** 2 / 2 - well
    z2 = 0.0  # of measurements that may both be wrong
    for log_f, (mean, deviation) in zip((log_f0, log_f1), measured, strict=True):
        squared = ((log_f - mean) / max(deviation, 1e-5)) ** 2
        cost, z2 = (cost + squared / 2, z2) if deviation < 0.02 else (cost, z2 + squared)
    return cost + 3 * z2 / (z2 + 6)


def share_in_front(E: Array, rays0: Array, rays1: Array, support: Array, angle: Array) -> float:
    """E (3, 3), rays (n, 3), support (n); rays whose directions differ by less than the angles (n) count anyway."""
    best = 0.0
    for R, t in poses(E):
        total = 0.0
        for a, b, weight, min_sine in zip(rays0, rays1, support, angle, strict=True):
            r = R @ a
            (z0, z1), *_ = np.linalg.lstsq(np.stack([-r, b], 1), t, rcond=None)  # z1 b = z0 r + t
            sine = np.linalg.norm(np.cross(b, r)) / (np.linalg.norm(b) * np.linalg.norm(r))
            parallel = sine < min_sine and b @ r > 0
            total += weight * ((z0 > 0 and z1 > 0) or parallel)
        best = max(best, total)
    return best / float(support.sum())

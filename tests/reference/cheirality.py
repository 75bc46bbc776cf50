"""The share of support in front of both cameras, by triangulating every match before each of E's four camera pairs."""

import numpy as np


def share_in_front(
    E: np.ndarray, rays0: np.ndarray, rays1: np.ndarray, support: np.ndarray, angle: np.ndarray
) -> float:
    """E (3, 3), rays (n, 3), support (n); rays whose directions differ by less than the angles (n) count anyway."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    best = 0.0
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            total = 0.0
            for a, b, weight, min_sine in zip(rays0, rays1, support, angle, strict=True):
                r = R @ a
                (z0, z1), *_ = np.linalg.lstsq(np.stack([-r, b], 1), t, rcond=None)  # z1 b = z0 r + t
                sine = np.linalg.norm(np.cross(b, r)) / (np.linalg.norm(b) * np.linalg.norm(r))
                parallel = sine < min_sine and b @ r > 0
                total += weight * ((z0 > 0 and z1 > 0) or parallel)
            best = max(best, total)
    return best / float(support.sum())

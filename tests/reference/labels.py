"""Labels of matches, point by point from the definitions."""

import math

import numpy as np

from fmtorch.scenes.raycast import Camera
from fmtorch.scenes.surfaces import Surfaces


def first_hit(surfaces: Surfaces, camera: Camera, x: float, y: float) -> tuple[int, np.ndarray]:
    """The first piece that the ray of an image point meets (-1: none), and depth at which it meets each piece's plane.

    All pieces are taken as opaque. Pieces are met from outside only, unless they have two sides.
    """
    arrays = surfaces.arrays()
    _, triangle, both_sides = surfaces.labels()
    ray = camera.R.T @ np.linalg.inv(camera.K) @ np.array([x, y, 1.0])  # a step of depth 1
    depths = np.full(len(surfaces), math.inf)
    best, nearest = -1, math.inf
    for i, (corner, U, V) in enumerate(zip(arrays["O"], arrays["U"], arrays["V"], strict=True)):
        if abs(np.linalg.det(np.stack([U, V, -ray], 1))) < 1e-12:
            continue
        s, t, depth = np.linalg.solve(np.stack([U, V, -ray], 1), camera.centre - corner)
        depths[i] = depth
        outside = both_sides[i] or np.cross(V, U) @ (camera.centre - corner) > 0
        within = min(s, t) >= 0 and (s + t <= 1 if triangle[i] else max(s, t) <= 1)
        if outside and within and 0.05 < depth < nearest:
            best, nearest = i, depth
    return best, depths


def transfer_error(x, depths, partner, K, K_other, R, t) -> float:  # type: ignore[no-untyped-def]
    """The smallest distance of one match's transferred point to its partner over some depths; NaN without any."""
    errors = []
    for depth in depths:
        if math.isnan(depth):
            continue
        X = R @ (depth * np.linalg.inv(K) @ np.array([*x, 1.0])) + t
        there = K_other @ X
        errors.append(math.dist(there[:2] / there[2], partner) if there[2] > 0 else math.inf)
    return min(errors) if errors else math.nan


def label(forward: float, backward: float, line: float) -> int:
    """1 within 3 px, 0 beyond 6 px, -1 between, by the larger transfer error that is known; else by the line."""
    known = [error for error in (forward, backward) if not math.isnan(error)]
    if not known:
        return 0 if line > 6 else -1
    if max(known) <= 3:
        return 1
    return 0 if max(known) > 6 else -1


def line_distance(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> float:
    """The larger distance of one match to its two epipolar lines."""
    a, b = F @ [*x0, 1.0], F.T @ [*x1, 1.0]
    return max(abs(a @ [*x1, 1.0]) / math.hypot(*a[:2]), abs(b @ [*x0, 1.0]) / math.hypot(*b[:2]))

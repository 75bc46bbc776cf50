"""Labels of matches and shared points of views from known depth, one point at a time."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from fmtorch.scenes import Camera
from fmtorch.scenes.surfaces import Surfaces
from tests.reference.solvers import epipolar_distances


def first_hit(surfaces: Surfaces, camera: Camera, x: float, y: float) -> tuple[int, np.ndarray]:
    """The first piece that the ray of an image point meets (-1: none), and depth at which it meets each piece's plane.
    All pieces are taken as opaque. Pieces are met from outside only, unless they have two sides."""
    _, triangle, both_sides = surfaces.labels()
    ray = camera.R.T @ np.linalg.inv(camera.K) @ np.array([x, y, 1.0])  # a step of depth 1
    depths = np.full(len(surfaces), math.inf)
    best, nearest = -1, math.inf
    for i, (corner, U, V) in enumerate(zip(*surfaces.arrays()[:3], strict=True)):
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
    return max(epipolar_distances(F, x0, x1))


def by_points(seen0: Sequence[int], seen1: Sequence[int]) -> float:
    """The smaller of the shares of either image's points that the other sees; 0 where an image sees none."""
    a, b = set(seen0), set(seen1)
    if not a or not b:
        return 0.0
    return min(len(a & b) / len(a), len(a & b) / len(b))


def share(
    depth0: Callable[[float, float], float], depth1: Callable[[float, float], float],
    K0: np.ndarray, K1: np.ndarray, sizes: tuple[tuple[int, int], tuple[int, int]], R: np.ndarray, t: np.ndarray,
    step: int, tolerance: float,
) -> float:  # fmt: skip
    """The share of the pixels of image 0 with depth whose points image 1 sees at the same depth, to a tolerance. A
    depth is a function of x and y, NaN where there is none. Pixels for which the other image has none do not count."""
    (h0, w0), (h1, w1) = sizes
    seen = count = 0
    for y in range(step // 2, h0, step):
        for x in range(step // 2, w0, step):
            z = depth0(x, y)
            if math.isnan(z):
                continue
            X = R @ (z * np.linalg.inv(K0) @ np.array([x, y, 1.0])) + t
            count += 1
            if X[2] <= 0:
                continue
            u, v, _ = K1 @ X / X[2]
            if not (-0.5 <= u < w1 - 0.5 and -0.5 <= v < h1 - 0.5):
                continue
            there = depth1(u, v)
            if math.isnan(there):
                count -= 1
            elif abs(there - X[2]) <= tolerance * there:
                seen += 1
    return seen / count if count else 0.0

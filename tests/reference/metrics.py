"""The metrics for one pair and one draw at a time, written from the definitions; random numbers are arguments."""

import itertools
import math

import numpy as np
from scipy.integrate import trapezoid

Array = np.ndarray


def homogeneous(x: Array) -> Array:
    return np.array([x[0], x[1], 1.0])


def distance(x: Array, line: Array, offset: float = 0.0) -> float:
    """Distance of a point from a line; `offset` is what the released evaluator adds to the length of the normal."""
    with np.errstate(all="ignore"):
        return float(abs(line @ homogeneous(x)) / (math.sqrt(line[0] ** 2 + line[1] ** 2) + offset))


def border_points(line: Array, size: Array, origin: float) -> tuple[Array, Array] | None:
    """Where a line enters and leaves an image, from left to right (a vertical one downwards); None where it misses."""
    a, b, c = line
    low, high = origin, origin + np.array([size[1], size[0]])
    ends = [(x, -(a * x + c) / b) for x in (low, high[0]) if b != 0]
    ends += [(-(b * y + c) / a, y) for y in (low, high[1]) if a != 0]
    points = [np.array(p) for p in ends if low <= p[0] <= high[0] and low <= p[1] <= high[1]]
    if len(points) < 2:
        return None
    points.sort(key=tuple)
    return points[0], points[-1]


def half_draw(F: Array, F_other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float] | None:
    """A match exact for F and its distances from the lines of F_other in images 0 and 1."""
    m = np.array([u[0] * size0[1] - 0.5, u[1] * size0[0] - 0.5])
    ends = border_points(F @ homogeneous(m), size1, -0.5)
    if ends is None:
        return None
    m1 = ends[0] + u[2] * (ends[1] - ends[0])
    return distance(m, F_other.T @ homogeneous(m1)), distance(m1, F_other @ homogeneous(m))


def nsgd(F_gt: Array, F_est: Array, size0: Array, size1: Array, uniforms: Array, samples: int) -> tuple[float, float]:
    """SGD and NSGD, both uncapped, from uniform numbers (tries, 6)."""
    pixels, diagonals = [], []
    for u in uniforms:
        first = half_draw(F_gt, F_est, size0, size1, u[:3])
        second = half_draw(F_est, F_gt, size0, size1, u[3:])
        if first is None or second is None:
            continue
        d0, d1 = first[0] + second[0], first[1] + second[1]
        pixels.append((d0 + d1) / 4)
        diagonals.append((d0 / math.hypot(*size0) + d1 / math.hypot(*size1)) / 4)
        if len(pixels) == samples:
            break
    if not pixels:
        return (math.hypot(*size0) + math.hypot(*size1)) / 2, 1.0
    return float(np.mean(pixels)), float(np.mean(diagonals))


def half_draw_released(F: Array, F_other: Array, size0: Array, size1: Array, u: Array) -> float | None:
    m = np.array([np.round(u[0] * size0[1]), np.round(u[1] * size0[0])])
    a, b, c = line = np.array([row[0] * m[0] + row[1] * m[1] + row[2] for row in F])
    ends = border_points(line, size1, 0.5)
    if ends is None:
        return None
    x = ends[0][0] + u[2] * (ends[1][0] - ends[0][0])
    with np.errstate(all="ignore"):
        m1 = np.array([x, np.float64(-(a * x + c)) / np.float64(b)])
        d1 = distance(m1, F_other @ homogeneous(m), 1e-10) / math.hypot(*size1)
        d0 = distance(m, F_other.T @ homogeneous(m1), 1e-10) / math.hypot(*size0)
    return (d0 + d1) / 2


def nsgd_released(F_gt: Array, F_est: Array, size0: Array, size1: Array, uniforms: Array, samples: int) -> float:
    """The released evaluator: sizes exchanged with the matrices, the sum divided by `samples`, NaN capped to 1."""
    total, accepted = 0.0, 0
    for u in uniforms:
        first = half_draw_released(F_gt, F_est, size0, size1, u[:3])
        second = half_draw_released(F_est, F_gt, size1, size0, u[3:])
        if first is None or second is None:
            continue
        total, accepted = total + (first + second) / 2, accepted + 1
        if accepted == samples:
            break
    return total / samples if total / samples < 1 else 1.0


def inlier_rate(
    F_gt: Array, x0: Array, x1: Array, inliers: Array, mask: Array, size0: Array, size1: Array, threshold: float = 0.003
) -> tuple[float, float]:
    """Shares of ground-truth inliers among the matches, and among those kept."""
    before, after = [], []
    for p0, p1, kept, given in zip(x0, x1, inliers, mask, strict=True):
        if not given:
            continue
        d1 = distance(p1, F_gt @ homogeneous(p0))
        d0 = distance(p0, F_gt.T @ homogeneous(p1))
        correct = d0 < threshold * math.hypot(*size0) and d1 < threshold * math.hypot(*size1)
        before.append(correct)
        if kept:
            after.append(correct)
    return tuple(sum(s) / len(s) if s else math.nan for s in (before, after))  # type: ignore[return-value]


def recall(nsgd: Array, threshold: float) -> float:
    return sum(1 for e in nsgd if e < threshold) / len(nsgd)


def mean_recall(nsgd: Array, maximum: float) -> float:
    """Area under the step curve of recall, piece by piece between the sorted errors."""
    edges = [0.0, *sorted(e for e in nsgd if e < maximum), maximum]
    return sum(recall(nsgd, high) * (high - low) for low, high in itertools.pairwise(edges)) / maximum


def rotation_angle(R0: Array, R1: Array) -> float:
    """Degrees, as SuperGlue and LoFTR compute it."""
    return float(np.rad2deg(np.abs(np.arccos(np.clip((np.trace(R0.T @ R1) - 1) / 2, -1.0, 1.0)))))


def direction_angle(t0: Array, t1: Array) -> float:
    """Degrees up to the sign of t, as SuperGlue and LoFTR compute it."""
    angle = signed_direction_angle(t0, t1)
    return min(angle, 180 - angle)


def signed_direction_angle(t0: Array, t1: Array) -> float:
    """Degrees, at most 180, as PoseBench computes it."""
    return float(np.rad2deg(np.arccos(np.clip(t0 @ t1 / (np.linalg.norm(t0) * np.linalg.norm(t1)), -1.0, 1.0))))


def closest_pose_error(poses: list[tuple[Array, Array]], R_gt: Array, t_gt: Array) -> tuple[float, float]:
    """Angles of the pose with the smallest sum of both, as PoseBench judges fundamental matrices; 180 each at most."""
    best = 180.0, 180.0
    for R, t in poses:
        angles = rotation_angle(R, R_gt), signed_direction_angle(t, t_gt)
        if sum(angles) < sum(best):
            best = angles
    return best


def pose_auc(errors: list[float], thresholds: tuple[float, ...]) -> list[float]:
    """The recall curve's area as SuperGlue's published evaluation computes it."""
    ordered = [0.0, *sorted(math.inf if math.isnan(e) else e for e in errors)]
    curve = [0.0, *((i + 1) / len(errors) for i in range(len(errors)))]
    areas = []
    for t in thresholds:
        last = int(np.searchsorted(ordered, t))
        r, e = [*curve[:last], curve[last - 1]], [*ordered[:last], t]
        areas.append(float(trapezoid(r, x=e)) / t)
    return areas


def pose_map(errors: list[float], thresholds: tuple[float, ...]) -> list[float]:
    """Mean average precision as OANet's published evaluation computes it: a histogram of bins of 5 degrees."""
    edges = np.arange(7) * 5
    share = np.cumsum(np.histogram(errors, edges)[0] / len(errors))
    return [float(np.mean(share[: int(t) // 5])) for t in thresholds]


def pose_maa(errors: list[float]) -> float:
    """Mean average accuracy to 10 degrees as the RANSAC tutorial (CVPR 2020) computes it."""
    return float(np.mean([np.mean([e <= t for e in errors]) for t in np.linspace(1.0, 10, 10)]))

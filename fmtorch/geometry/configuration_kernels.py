"""Evidence for the kinds of an image pair, compiled; see `configuration`. Matches are those of one pair, in pixels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.arithmetic_kernels import exponential, logarithm
from fmtorch.geometry.homography_objective_kernels import HOMOGRAPHY
from fmtorch.geometry.residual_kernels import SAMPSON
from fmtorch.geometry.rotation_kernels import Cameras, fit_rotation

TAIL = 2.5  # noises of half of the right matches: keypoints err by more than the normal law says
START, COARSEST = 1 / 640, 1 / 160  # noise that is tried first, and the largest, of the side of an image
FINEST = 0.1  # px; no keypoint is found more exactly
LOSS = 3.0  # noises; scale of the loss by which a rotation and a copy are fitted
STEPS, COPY_STEPS = 20, 8
NOISE_TOLERANCE, SHARE_TOLERANCE = 0.01, 1e-3  # of the last step: relative, and of a share
GROUP = 16  # densities of up to some millions, whose product is one of float64
HALF = 0.5  # of a match that each component has beforehand
FARTHEST = 40.0  # half squared noises, beyond which a density is zero
ROOT2PI, ROOT2 = math.sqrt(2 * math.pi), math.sqrt(2)
MATCHES, NOISE, LINE, PLANE, BOTH, TURN, COPY, ON_PLANE, ON_LINE, FOCALS, ROTATION, SCALED = (
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 20,
)  # fmt: skip
COLUMNS = 23
of_line, of_plane = SAMPSON.of_match, HOMOGRAPHY.of_match


class Matches(NamedTuple):
    """x0, x1 (n, 2), which are real, mask (n,), their relative noise (n,), empty where unknown."""

    x0: F8x2
    x1: F8x2
    mask: B1x1
    noise: F8x1


class Models(NamedTuple):
    """F, H (3, 3), zero where there is none; size0, size1: (h, w), empty where unknown."""

    F: F8x2
    H: F8x2
    size0: F8x1
    size1: F8x1


@kernel
def weigh(matches: Matches, models: Models, cameras: Cameras, out: F8x1) -> None:
    """The log likelihoods of the kinds, and what was fitted for them -> out (COLUMNS,), by the names above."""
    points, noise = matrix(4, len(matches.mask)), vector(len(matches.mask))
    n = _gather(matches, points, noise)
    points, noise = points[:, :n], noise[:n]
    for k in range(COLUMNS):
        out[k] = 0.0
    out[MATCHES] = n
    if n == 0:
        return
    side = _side(points, models.size0, models.size1)
    has_line, has_plane = np.any(models.F != 0), np.any(models.H != 0)
    line, plane, r, work = np.full(n, math.inf), np.full(n, math.inf), vector(n), matrix(2, n)
    s = COARSEST * side
    if has_line:
        _distances(models.F.ravel(), points, noise, True, line)
        s = min(s, _noise(line, side, 1, work))
    if has_plane:
        _distances(models.H.ravel(), points, noise, False, plane)
        s = min(s, _noise(plane, side, 2, work))
    out[NOISE] = s
    d, share = np.zeros((2, n)), np.zeros(3)
    _densities(line, s, side, 1, work[0], d[1])
    out[LINE] = _log_likelihood(d[1:], share)
    if not has_plane:
        out[BOTH], out[ON_LINE] = out[LINE], share[1]
        return
    _densities(plane, s, side, 2, work[0], d[0])
    out[PLANE] = _log_likelihood(d[:1], share)
    out[BOTH] = _log_likelihood(d, share)
    out[ON_PLANE], out[ON_LINE] = share[1], share[2]
    H = vector(9)
    _fit_copy(points, noise, plane, s, H)
    out[SCALED], out[SCALED + 1], out[SCALED + 2] = H[0], H[2], H[5]
    _distances(H, points, noise, False, r)
    _densities(r, s, side, 2, work[0], d[0])
    out[COPY] = _log_likelihood(d[:1], share)
    out[TURN] = -math.inf
    if cameras.K0[2, 2] != 0:
        cost = fit_rotation(points, noise, models.H.ravel(), cameras, s, out[FOCALS : ROTATION + 9], H)
        if math.isfinite(cost):
            _distances(H, points, noise, False, r)
            _densities(r, s, side, 2, work[0], d[0])
            out[TURN] = _log_likelihood(d[:1], share) - cost


@inner
def _gather(matches: Matches, points: Array, noise: Array) -> int:
    """The real matches with finite coordinates -> points (4, n), noise (n,); how many."""
    x0, x1, mask, given = matches
    count = 0
    for i in range(len(mask)):
        relative = given[i] if len(given) else 1.0
        total = x0[i, 0] + x0[i, 1] + x1[i, 0] + x1[i, 1]
        if mask[i] and math.isfinite(total) and relative > 0 and math.isfinite(relative):
            points[0, count], points[1, count] = x0[i, 0], x0[i, 1]
            points[2, count], points[3, count] = x1[i, 0], x1[i, 1]
            noise[count] = relative
            count += 1
    return count


@inner
def _side(points: Array, size0: Array, size1: Array) -> float:
    """The side of a square as large as the images, in the geometric mean; without sizes, as their matches' boxes."""
    area = 1.0
    for image in range(2):
        size = size0 if image == 0 else size1
        if len(size):
            area *= size[0] * size[1]
        else:
            for axis in range(2):
                x = points[2 * image + axis]
                area *= max(np.max(x) - np.min(x), 1.0)
    return math.sqrt(math.sqrt(area))


@inner
def _distances(model: Array, points: Array, noise: Array, line: bool, out: Array) -> None:
    """Squared Sampson distances in squared noises of each match -> out (n,); infinite where there is none."""
    for i in range(len(out)):
        x, y, u, v = points[0, i], points[1, i], points[2, i], points[3, i]
        r2 = of_line(model, x, y, u, v) if line else of_plane(model, x, y, u, v)
        r2 /= noise[i] * noise[i]
        out[i] = r2 if r2 < math.inf else math.inf  # what is not a number, too


@inner
def _noise(r2: Array, side: float, dimensions: int, work: Array) -> float:
    """The noise of right matches beside wrong ones, by expectation and maximisation. work: (2, n)."""
    n, s = len(r2), min(max(START * side, FINEST), COARSEST * side)
    share = 0.5
    for _ in range(STEPS):
        peak, tail = _peaks(s, side, dimensions)
        _decay(r2, 1 / (2 * s * s), share * peak, work[0])
        _decay(r2, 1 / (2 * TAIL * TAIL * s * s), share * tail, work[1])
        right, squares, limit = 0.0, 0.0, FARTHEST * 2 * TAIL * TAIL * s * s
        for i in range(n):
            if r2[i] < limit:
                p, q = work[0, i], work[1, i]
                inverse = 1 / (1 - share + p + q)
                right += (p + q) * inverse
                squares += r2[i] * (p + q / (TAIL * TAIL)) * inverse
        share = (right + HALF) / (n + 2 * HALF)
        last, s = s, min(max(math.sqrt(squares / max(dimensions * right, 1e-9)), FINEST), COARSEST * side)
        if abs(s - last) < NOISE_TOLERANCE * last:
            break
    return s


@inner
def _decay(r2: Array, by: float, peak: float, out: Array) -> None:
    """peak exp(-by r2) -> out (n,), as good as zero beyond FARTHEST."""
    for i in range(len(out)):
        z = r2[i] * by
        out[i] = peak * exponential(-(z if z < FARTHEST else FARTHEST))


@inner
def _peaks(s: float, side: float, dimensions: int) -> tuple[float, float]:
    """Half the densities of matches at distance zero over that of wrong ones, of usual noise and of TAIL times it."""
    if dimensions == 1:
        peak = side / (2 * ROOT2 * ROOT2PI * s)
        return peak, peak / TAIL
    peak = side * side / (8 * math.pi * s * s)
    return peak, peak / (TAIL * TAIL)


@inner
def _densities(r2: Array, s: float, side: float, dimensions: int, work: Array, out: Array) -> None:
    """Of right matches over that of wrong ones -> out (n,); of one dimension, near a line, or of two, near a point."""
    peak, tail = _peaks(s, side, dimensions)
    _decay(r2, 1 / (2 * s * s), peak, out)
    _decay(r2, 1 / (2 * TAIL * TAIL * s * s), tail, work)
    for i in range(len(out)):
        out[i] += work[i]


@inner
def _log_likelihood(d: Array, share: Array) -> float:
    """The maximum over the shares of wrong and right matches, d (j, n) -> share (j + 1,), of sum log sum w d."""
    j, n = d.shape
    share[0], share[1], share[2] = 1 / (j + 1), 1 / (j + 1), 1 / (j + 1) if j > 1 else 0.0
    for _ in range(STEPS):
        on_plane, on_line = 0.0, 0.0
        if j > 1:
            for i in range(n):
                p, q = share[1] * d[0, i], share[2] * d[1, i]
                inverse = 1 / (share[0] + p + q)
                on_plane += p * inverse
                on_line += q * inverse
        else:
            for i in range(n):
                p = share[1] * d[0, i]
                on_plane += p / (share[0] + p)
        total, moved = n + HALF * (j + 1), 0.0
        on_plane, on_line = (on_plane + HALF) / total, (on_line + HALF) / total if j > 1 else 0.0
        moved = max(abs(on_plane - share[1]), abs(on_line - share[2]))
        share[0], share[1], share[2] = 1 - on_plane - on_line, on_plane, on_line
        if moved < SHARE_TOLERANCE:
            break
    value, product = 0.0, 1.0
    for i in range(n):
        product *= share[0] + share[1] * d[0, i] + (share[2] * d[1, i] if j > 1 else 0.0)
        if i % GROUP == GROUP - 1:
            value += logarithm(product)
            product = 1.0
    return value + logarithm(product)


@inner
def _fit_copy(points: Array, noise: Array, plane: Array, s: float, H: Array) -> None:
    """x1 = a x0 + b by reweighted least squares of Geman and McClure's loss, from distances to a plane -> H (9,)."""
    n, limit = len(noise), (LOSS * s) * (LOSS * s)
    r2 = plane.copy()
    for k in range(9):
        H[k] = 0.0
    H[0], H[4], H[8] = 1.0, 1.0, 1.0
    for _ in range(COPY_STEPS):
        total, x, y, u, v = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            w = limit / (limit + r2[i]) * (limit / (limit + r2[i])) / (noise[i] * noise[i]) if r2[i] < math.inf else 0.0
            total += w
            x, y, u, v = x + w * points[0, i], y + w * points[1, i], u + w * points[2, i], v + w * points[3, i]
        if not total > 0:
            return
        x, y, u, v = x / total, y / total, u / total, v / total
        across, along = 0.0, 0.0
        for i in range(n):
            w = limit / (limit + r2[i]) * (limit / (limit + r2[i])) / (noise[i] * noise[i]) if r2[i] < math.inf else 0.0
            dx, dy = points[0, i] - x, points[1, i] - y
            across += w * (dx * (points[2, i] - u) + dy * (points[3, i] - v))
            along += w * (dx * dx + dy * dy)
        a = across / along if along > 0 and across > 0 else 1.0
        H[0], H[4], H[2], H[5] = a, a, u - a * x, v - a * y
        _distances(H, points, noise, False, r2)

"""Least-squares matching of one window, compiled: its linear model, Gauss-Newton steps, the covariance of the point.

Lucas and Kanade (IJCAI 1981) and Gruen (Adaptive least squares correlation, 1985), with an affine map, gain and offset,
in the inverse compositional form (Baker and Matthews, IJCV 2004, section 3.2): the derivatives are those of image 0,
made once, and every step samples image 1.
"""

import math
from typing import Any, NamedTuple

from fmtorch.jit.kernel import Array, F8x1, F8x2, I8x2, U1x1, inner, matrix, vector
from fmtorch.jit.lanes import fill, load, store

PARAMETERS = 8  # offset, gain, four of the affine map, two of the shift: as many as `lanes` has lanes
WINDOW_SIGMA = 0.8  # of the Gaussian weight, in radii of the window
DAMPED_FROM, DAMPING = 2, 1e-3  # of the affine map and the shift, relative to their curvature
CONVERGED = 0.01  # samples: after a shorter step one more is taken
MIN_CONTRAST = 0.5  # grey levels, standard deviation of a window with texture
MAX_CHANGE = 4.0  # of area, by one step
SAMPLE_PITCH = 3.0  # pixels of a level between samples, at most; half of it where there are finer levels


class Pyramid(NamedTuple):
    """A grey image at ever coarser scales, as `core.grey_pyramid` makes it.

    pixels: (sum,), of all levels, row by row. levels: (l, 3), of each its height, its width and where it begins. Point
    x of the image is at x / 2^l of level l.
    """

    pixels: U1x1
    levels: I8x2


class Template(NamedTuple):
    """The linear model of a window of image 0.

    grid: samples (m, 2) in steps from the centre. weight: (m,), of sum one. columns: (m, 8), the derivatives of a grey
    level by the parameters: offset, gain, the four entries of the affine map, the shift in steps. weighted: (m, 8), the
    same times the weights. L: (8, 8), the Cholesky factor of their products.
    """

    grid: F8x2
    weight: F8x1
    columns: F8x2
    weighted: F8x2
    L: F8x2


@inner
def grid(radius: int) -> tuple[Array, Array, float]:
    """A window's samples (m, 2) in steps from its centre; their weights (m,), of sum one; the sum of their squares."""
    side = 2 * radius + 1
    samples, weight, total, squares = matrix(side * side, 2), vector(side * side), 0.0, 0.0
    for i in range(side * side):
        samples[i, 0], samples[i, 1] = i % side - radius, i // side - radius
        r2 = (samples[i, 0] * samples[i, 0] + samples[i, 1] * samples[i, 1]) / (radius * radius)
        t = 1.0 + r2 / (16.0 * WINDOW_SIGMA * WINDOW_SIGMA)  # t^-8, nearly a Gaussian, has the same bits everywhere
        t *= t
        t *= t
        weight[i] = 1.0 / (t * t)
        total += weight[i]
    for i in range(side * side):
        weight[i] /= total
        squares += weight[i] * weight[i]
    return samples, weight, squares


@inner
def level_for(image: Pyramid, spacing: float) -> int:
    """The level for samples at a distance in pixels: the first on which it is below `SAMPLE_PITCH`, else the last."""
    level = 0
    while level + 1 < len(image.levels) and spacing >= SAMPLE_PITCH * (1 << level):
        level += 1
    return level


@inner
def _inside(image: Pyramid, level: int, x: float, y: float) -> bool:
    """Whether a point has four pixels of the level around it; no point that is not finite has."""
    return bool(0.0 <= x < image.levels[level, 1] - 1 and 0.0 <= y < image.levels[level, 0] - 1)


@inner
def derivatives(image: Pyramid, level: int, x: float, y: float, step: float, template: Any) -> bool:
    """The columns of the linear model of the window around a point of a level; whether the image holds all of it."""
    samples, columns = template.grid, template.columns
    pixels, width, begin = image.pixels, image.levels[level, 1], image.levels[level, 2]
    reach = step * samples[len(samples) - 1, 0]
    if not (_inside(image, level, x - reach, y - reach) and _inside(image, level, x + reach, y + reach)):
        return False
    for i in range(len(samples)):
        px, py = x + step * samples[i, 0], y + step * samples[i, 1]
        ix, iy = int(px), int(py)
        fx, fy = px - ix, py - iy
        at = begin + iy * width + ix
        p, q, r, s = float(pixels[at]), float(pixels[at + 1]), float(pixels[at + width]), float(pixels[at + width + 1])
        mixed = s - r - q + p
        gx, gy = step * (q - p + fy * mixed), step * (r - p + fx * mixed)
        columns[i, 0], columns[i, 1] = 1.0, p + fx * (q - p) + fy * (r - p + fx * mixed)
        columns[i, 2], columns[i, 3] = gx * samples[i, 0], gx * samples[i, 1]
        columns[i, 4], columns[i, 5] = gy * samples[i, 0], gy * samples[i, 1]
        columns[i, 6], columns[i, 7] = gx, gy
    return True


@inner
def factorize(template: Any) -> bool:
    """The weighted columns and the factor of the normal equations; whether there is texture, in every direction."""
    columns, weighted, L = template.columns, template.weighted, template.L
    for i in range(len(columns)):
        store(weighted, i, load(columns, i) * template.weight[i])
    for r in range(PARAMETERS):
        total = fill(0.0)
        for i in range(len(columns)):
            total += load(weighted, i) * columns[i, r]
        store(L, r, total)
    for j in range(PARAMETERS):
        if j >= DAMPED_FROM:
            L[j, j] *= 1.0 + DAMPING
        for i in range(j, PARAMETERS):
            product = L[i, j]
            for k in range(j):
                product -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = product / L[j, j]
            elif product > 0.0:
                L[j, j] = math.sqrt(product)
            else:
                return False
    return bool(L[1, 1] > MIN_CONTRAST)


@inner
def search(
    image: Pyramid, level: int, template: Any, start: Array, iterations: int, best: Array
) -> tuple[float, float, float]:
    """Gauss-Newton steps from a place, point and affine map (6,), to that of the highest correlation -> best.

    The correlations at the start and at the best place, and the residual variance there, in grey levels of image 0.
    """
    L, solution, first, highest, variance = template.L, vector(PARAMETERS), -2.0, -2.0, math.inf
    place, short = start.copy(), False
    best[:] = start
    for iteration in range(iterations + 1):
        energy = _products(image, level, template, place, solution)
        if energy < 0.0:
            break
        _forward(L, solution)
        energy -= solution[0] * solution[0]  # of the window less its mean
        correlation = solution[1] / math.sqrt(max(energy, MIN_CONTRAST * MIN_CONTRAST))
        first = correlation if iteration == 0 else first
        if correlation > highest:
            highest, gain = correlation, solution[1] / L[1, 1]
            best[:] = place
            for k in range(1, PARAMETERS):
                energy -= solution[k] * solution[k]
            variance = max(energy, 0.0) / (gain * gain)
        _backward(L, solution)
        if short or not (solution[1] > 0.0 and _compose(place, solution)):
            break
        short = iteration > 0 and abs(solution[6]) + abs(solution[7]) < CONVERGED * solution[1]
    return first, highest, variance


@inner
def _compose(place: Array, solution: Array) -> bool:
    """The place after a step: its map after the inverse of that which the step makes of the window of image 0.

    False, and the place as it was, for a step that changes the area by too much.
    """
    gain = solution[1]
    p, q, r, s = 1.0 + solution[2] / gain, solution[3] / gain, solution[4] / gain, 1.0 + solution[5] / gain
    area = p * s - q * r
    if not 1.0 / MAX_CHANGE < area < MAX_CHANGE:
        return False
    for k in range(2):
        a, b = place[2 + 2 * k], place[3 + 2 * k]
        a, b = (a * s - b * r) / area, (b * p - a * q) / area
        place[k] -= (a * solution[6] + b * solution[7]) / gain
        place[2 + 2 * k], place[3 + 2 * k] = a, b
    return True


@inner
def _products(image: Pyramid, level: int, template: Any, place: Array, out: Array) -> float:
    """Products of the window at a place with the columns -> out (8,), and with itself; -1 where it is not inside."""
    pixels, width, begin = image.pixels, image.levels[level, 1], image.levels[level, 2]
    samples, weight, weighted = template.grid, template.weight, template.weighted
    x, y, a, b, c, d = place[0], place[1], place[2], place[3], place[4], place[5]
    reach = samples[len(samples) - 1, 0]
    ex, ey = reach * (abs(a) + abs(b)), reach * (abs(c) + abs(d))
    if not (_inside(image, level, x - ex, y - ey) and _inside(image, level, x + ex, y + ey)):
        return -1.0
    total, energy = fill(0.0), 0.0
    for i in range(len(samples)):
        px, py = x + a * samples[i, 0] + b * samples[i, 1], y + c * samples[i, 0] + d * samples[i, 1]
        ix, iy = int(px), int(py)
        fx, fy = px - ix, py - iy
        at = begin + iy * width + ix
        p, q, r, s = float(pixels[at]), float(pixels[at + 1]), float(pixels[at + width]), float(pixels[at + width + 1])
        value = p + fx * (q - p) + fy * (r - p + fx * (s - r - q + p))
        total += load(weighted, i) * value
        energy += weight[i] * value * value
    store(out.reshape(1, PARAMETERS), 0, total)
    return energy


@inner
def _forward(L: Array, b: Array) -> None:
    """L^-1 b, in place."""
    for i in range(len(b)):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@inner
def _backward(L: Array, b: Array) -> None:
    """L^-T b, in place."""
    for i in range(len(b) - 1, -1, -1):
        for k in range(i + 1, len(b)):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@inner
def covariance(L: Array, best: Array, variance: float, out: Array) -> None:
    """The covariance of the point, xx, xy, yy -> out (3,): that of the shift in steps, mapped to pixels.

    The last two rows of L are the factor of the shift's information, all other parameters eliminated.
    """
    p, q, r = L[6, 6], L[7, 6], L[7, 7]
    a, c = best[2] / p, best[4] / p
    b, d = (best[3] - a * q) / r, (best[5] - c * q) / r
    out[0], out[1], out[2] = variance * (a * a + b * b), variance * (a * c + b * d), variance * (c * c + d * d)


@inner
def largest_variance(covariance: Array) -> float:
    """The larger eigenvalue of a covariance xx, xy, yy."""
    half = (covariance[0] - covariance[2]) / 2.0
    return float((covariance[0] + covariance[2]) / 2.0 + math.sqrt(half * half + covariance[1] * covariance[1]))

"""Matches refined by what the images show around them, and how exact each then is: least-squares matching.

Lucas and Kanade (IJCAI 1981) and Gruen (Adaptive least squares correlation, 1985), with an affine map, gain and offset,
in the inverse compositional form (Baker and Matthews, IJCV 2004, section 3.2): the derivatives are those of image 0,
made once, and every step samples image 1."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from fmtorch.core import Correspondences, GreyPyramid, PairImages
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, F8x3, I8x2, U1x1, inner, kernel, matrix, vector
from fmtorch.jit.lanes import fill, load, store
from fmtorch.jobs.execution import mapped
from fmtorch.pruning.neighbors import neighbour_maps

PARAMETERS = 8  # offset, gain, four of the affine map, two of the shift: as many as `lanes` has lanes
WINDOW_SIGMA = 0.8  # of the Gaussian weight, in radii of the window
DAMPED_FROM, DAMPING = 2, 1e-3  # of the affine map and the shift, relative to their curvature
CONVERGED = 0.01  # samples: after a shorter step one more is taken
MIN_CONTRAST = 0.5  # grey levels, standard deviation of a window with texture
MAX_CHANGE = 4.0  # of area, by one step
SAMPLE_PITCH = 3.0  # pixels of a level between samples, at most; half of it where there are finer levels


class Pyramid(NamedTuple):
    """A grey image at ever coarser scales, as `core.stages.grey_pyramid` makes it.
    pixels: (sum,), of all levels, row by row. levels: (l, 3): height, width, beginning. Point x is at x / 2^l there."""

    pixels: U1x1
    levels: I8x2


class Template(NamedTuple):
    """The linear model of a window of image 0.
    grid: samples (m, 2) in steps from the centre. weight: (m,), of sum one. columns: (m, 8), the derivatives of a grey
    level by the parameters: offset, gain, the four entries of the affine map, the shift in steps. weighted: (m, 8), the
    same times the weights. L: (8, 8), the Cholesky factor of their products."""

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
    The correlations at the start and at the best place, and the residual variance there, in grey levels of image 0."""
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
    False, and the place as it was, for a step that changes the area by too much."""
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
    The last two rows of L are the factor of the shift's information, all other parameters eliminated."""
    p, q, r = L[6, 6], L[7, 6], L[7, 7]
    a, c = best[2] / p, best[4] / p
    b, d = (best[3] - a * q) / r, (best[5] - c * q) / r
    out[0], out[1], out[2] = variance * (a * a + b * b), variance * (a * c + b * d), variance * (c * c + d * d)


@inner
def largest_variance(covariance: Array) -> float:
    """The larger eigenvalue of a covariance xx, xy, yy."""
    half = (covariance[0] - covariance[2]) / 2.0
    return float((covariance[0] + covariance[2]) / 2.0 + math.sqrt(half * half + covariance[1] * covariance[1]))


class Windows(NamedTuple):
    """Of each match: points x0, x1 (n, 2), affine map (n, 2, 2), distance of a window's samples in image 0 (n,), px."""

    x0: F8x2
    x1: F8x2
    affine: F8x3
    spacing: F8x1


class Fit(NamedTuple):
    """How windows are fitted.
    radius: samples from the centre of a window to its sides. iterations: at most. min_correlation: of two windows that
    show one surface. max_shift: of a point, in samples. max_deviation: px, of a point in its worst direction."""

    radius: int
    iterations: int
    min_correlation: float
    max_shift: float
    max_deviation: float


class Refined(NamedTuple):
    """Of each match: the point (n, 2) and the affine map (n, 2, 2), the covariance xx, xy, yy of the point (n, 3) in
    square pixels, the correlation (n,) and whether it was refined (n,); where not, point and map are as given."""

    x1: F8x2
    affine: F8x3
    covariance: F8x2
    correlation: F8x1
    refined: B1x1


@kernel
def refine_windows(windows: Windows, image0: Pyramid, image1: Pyramid, fit: Fit, out: Refined) -> None:
    """Least-squares matching of n windows of one pair -> out."""
    samples, weight, spread = grid(fit.radius)
    columns, weighted = matrix(len(weight), PARAMETERS), matrix(len(weight), PARAMETERS)
    template = Template(samples, weight, columns, weighted, matrix(PARAMETERS, PARAMETERS))
    place, best = vector(6), vector(6)
    for i in range(len(windows.spacing)):
        out.x1[i], out.affine[i] = windows.x1[i], windows.affine[i]
        out.covariance[i], out.correlation[i], out.refined[i] = 0.0, 0.0, False
        affine, spacing = windows.affine[i], windows.spacing[i]
        scale = math.sqrt(abs(affine[0, 0] * affine[1, 1] - affine[0, 1] * affine[1, 0]))
        if not (0.0 < scale < math.inf and 0.0 < spacing < math.inf):
            continue
        level0, level1 = level_for(image0, spacing), level_for(image1, spacing * scale)
        size0, size1 = float(1 << level0), float(1 << level1)  # of a level's pixel, px
        x, y = windows.x0[i, 0] / size0, windows.x0[i, 1] / size0
        if not (derivatives(image0, level0, x, y, spacing / size0, template) and factorize(template)):
            continue
        step = spacing / size1
        for k in range(2):
            place[k] = windows.x1[i, k] / size1
            place[2 + k], place[4 + k] = step * affine[0, k], step * affine[1, k]
        first, correlation, variance = search(image1, level1, template, place, fit.iterations, best)
        dx, dy, limit = best[0] - place[0], best[1] - place[1], fit.max_shift * scale * step
        if not (correlation >= max(first, fit.min_correlation) and dx * dx + dy * dy <= limit * limit):
            continue
        for k in range(2, 6):
            best[k] *= size1  # px of image 1 in a step
        covariance(template.L, best, variance * spread, out.covariance[i])
        if not largest_variance(out.covariance[i]) <= fit.max_deviation * fit.max_deviation:
            out.covariance[i] = 0.0
            continue
        for k in range(2):
            out.x1[i, k] = best[k] * size1
            out.affine[i, 0, k], out.affine[i, 1, k] = best[2 + k] / spacing, best[4 + k] / spacing
        out.correlation[i], out.refined[i] = correlation, True


MIN_PRIOR = 0.02  # matches less likely than that are not taken for less exact, as in `match_noise`


@dataclasses.dataclass(frozen=True)
class RefineMatches:
    """Moves the point of image 1 to where the image looks most like image 0 around its partner; prunes nothing.

    Least-squares matching (Lucas and Kanade, IJCAI 1981; Gruen, 1985): a window of image 0 is fitted to image 1 by an
    affine map, gain and offset, from the map between the two local affine frames, or without frames from a similarity
    that neighbouring matches agree on. A match stays as it is where a window
    reaches over the border, where the fit lowers the correlation or ends below `min_correlation` or too far away, and
    where the image does not determine the point in all directions (no texture, an edge). A match that is refined gets
    the frame of its affine map and a `noise` from its own normal equations, relative to that of an unrefined match with
    noise one; others keep theirs. Gradients do not pass: refined points are constants.

    radius: samples from the centre of a window to its sides. iterations: at most. spacing: between samples, at
    least, px. share: the same, of the half side of the match's frame. min_correlation, max_shift (in samples),
    max_deviation (px): see above. floor, slope: the expected distance to the epipolar line of a refined match is
    ``sqrt(floor^2 + (slope s)^2)`` px with s the standard deviation by the normal equations, unexplained: its residuals
    are not independent. usual: that of an unrefined match of noise one, px. Noise grows with P^(-1/4)."""

    radius: int
    iterations: int
    spacing: float
    share: float
    min_correlation: float
    max_shift: float
    max_deviation: float
    floor: float
    slope: float
    usual: float

    kernels: ClassVar = (refine_windows, neighbour_maps)

    def __post_init__(self) -> None:
        if self.radius < 1 or self.iterations < 1 or not self.spacing > 0:
            given = f"radius={self.radius}, iterations={self.iterations}, spacing={self.spacing}"
            raise ValueError(f"{given}; radius and iterations must be at least 1, spacing above 0 px")

    def __call__(self, c: Correspondences) -> Correspondences:
        """Raises ValueError: matches alone do not say what the images show."""
        raise ValueError("refine_matches needs the images: put it into a pipeline, or call with_images(c, images)")

    def with_images(self, c: Correspondences, images: Callable[[int], PairImages]) -> Correspondences:
        """The same matches refined. images: of pair i, asked for where it has matches."""
        x1, lafs1 = c.x1.detach().clone(), None if c.lafs1 is None else c.lafs1.detach().clone()
        noise = torch.ones_like(c.x0[..., 0]) if c.noise is None else c.noise.detach().clone()
        fields = {"x0": c.x0, "x1": c.x1}
        if c.lafs0 is not None and c.lafs1 is not None:
            fields |= {"lafs0": c.lafs0, "lafs1": c.lafs1}

        def refine(pair: int) -> None:
            arrays = {name: _array(tensor[pair]) for name, tensor in fields.items()}
            finite = [np.isfinite(array).all(tuple(range(1, array.ndim))) for array in arrays.values()]
            live = np.flatnonzero(_array(c.mask[pair]) & np.all(finite, 0))
            if not len(live):
                return
            rows = {name: array[live] for name, array in arrays.items()}
            out = self._refined(rows, *images(pair))
            index = torch.from_numpy(live[out.refined]).to(x1.device)
            x1[pair, index] = _like(out.x1[out.refined], x1)
            if lafs1 is not None and "lafs0" in rows:
                frames = np.concatenate([_product(out.affine, rows["lafs0"][:, :, :2]), out.x1[:, :, None]], 2)
                lafs1[pair, index] = _like(frames[out.refined], lafs1)
            noise[pair, index] = _like(self._noise(out), noise) * self._doubt(c.prior, pair, index)

        mapped(refine, range(len(c)))
        return c.derived(x1=x1, lafs1=lafs1, noise=noise)

    def _refined(self, rows: dict[str, Array], image0: GreyPyramid, image1: GreyPyramid) -> Refined:
        n = len(rows["x0"])
        affine, side = np.empty((n, 2, 2)), np.zeros(n)
        if "lafs0" in rows:
            affine, side = _frame_maps(rows["lafs0"], rows["lafs1"])
        else:
            neighbour_maps(rows["x0"], rows["x1"], affine)
        with np.errstate(all="ignore"):  # maps that are none: the kernel leaves what is not finite
            scale = np.sqrt(np.abs(affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0]))
            spacing = np.maximum(np.maximum(self.spacing, self.spacing / scale), self.share * side)
        windows = Windows(rows["x0"], rows["x1"], affine, spacing)
        limits = map(float, (self.min_correlation, self.max_shift, self.max_deviation))
        fit = Fit(self.radius, self.iterations, *limits)
        out = Refined(np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_))
        refine_windows(windows, Pyramid(*image0), Pyramid(*image1), fit, out)
        return out

    def _noise(self, out: Refined) -> Array:
        """Of those refined: the expected distance to the epipolar line, in that of a usual match.
        The point's covariance counts as if both points shared it: an error e of image 1 moves the Sampson distance by
        at most ``e / sqrt(1 + s^2)``, s the change of scale."""
        (xx, _, yy), affine = out.covariance[out.refined].T, out.affine[out.refined]
        area = np.abs(affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0])
        variance = (xx + yy) / (1 + area)
        return np.asarray(np.sqrt(self.floor * self.floor + self.slope * self.slope * variance) / self.usual)

    def _doubt(self, prior: torch.Tensor | None, pair: int, index: torch.Tensor) -> Any:
        """P^(-1/4) of these matches."""
        if prior is None:
            return 1.0
        P = prior.detach()[pair, index]
        return sqrt(sqrt(torch.where(torch.isfinite(P), P, 1).clamp_min(MIN_PRIOR))).reciprocal()


def _frame_maps(lafs0: Array, lafs1: Array) -> tuple[Array, Array]:
    """The affine maps (n, 2, 2) from frames of image 0 to those of image 1, and the half sides (n,) of the former."""
    (a, b), (c, d) = lafs0[:, 0, :2].T, lafs0[:, 1, :2].T
    determinant = a * d - b * c
    with np.errstate(all="ignore"):  # of a frame without area there is none
        inverse = np.stack([d, -b, -c, a], 1).reshape(-1, 2, 2) / determinant[:, None, None]
        maps = np.ascontiguousarray(_product(lafs1[:, :, :2], inverse))
    return maps, np.sqrt(np.abs(determinant))


def _product(a: Array, b: Array) -> Array:
    """Matrix products (n, 2, 2), in one order of sums."""
    return a[:, :, :1] * b[:, :1, :] + a[:, :, 1:] * b[:, 1:, :]  # type: ignore[no-any-return]


def _array(tensor: torch.Tensor) -> Array:
    tensor = tensor.detach().cpu()
    return (tensor.to(torch.float64) if tensor.is_floating_point() else tensor).contiguous().numpy()


def _like(array: Array, tensor: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(array).to(tensor)

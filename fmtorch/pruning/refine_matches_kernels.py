"""`refine_matches` for one pair, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

from fmtorch.compiling.arrays import B1x1, F8x1, F8x2, F8x3
from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.pruning.window_kernels import (
    PARAMETERS,
    Pyramid,
    Template,
    covariance,
    derivatives,
    factorize,
    grid,
    largest_variance,
    level_for,
    search,
)


class Windows(NamedTuple):
    """Of each match: points x0, x1 (n, 2), the affine map between their surroundings (n, 2, 2), the distance of the
    window's samples in image 0 (n,), all in pixels, and whether to refine it (n,)."""

    x0: F8x2
    x1: F8x2
    affine: F8x3
    spacing: F8x1
    mask: B1x1


class Fit(NamedTuple):
    """How windows are fitted.

    radius: samples from the centre of a window to its sides. iterations: at most. min_correlation: of two windows that
    show one surface. max_shift: of a point, in samples. max_deviation: of a point in the direction in which it is least
    exact, in pixels.
    """

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
    for i in range(len(windows.mask)):
        out.x1[i], out.affine[i] = windows.x1[i], windows.affine[i]
        out.covariance[i], out.correlation[i], out.refined[i] = 0.0, 0.0, False
        affine, spacing = windows.affine[i], windows.spacing[i]
        scale = math.sqrt(abs(affine[0, 0] * affine[1, 1] - affine[0, 1] * affine[1, 0]))
        if not (windows.mask[i] and 0.0 < scale < math.inf and 0.0 < spacing < math.inf):
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

"""Matches refined by what the images show around them, and how exact each then is."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fmtorch.core.grey_pyramid import GreyPyramid
from fmtorch.core.stages import PairImages
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, F8x3, kernel, matrix, vector
from fmtorch.jobs.execution import mapped
from fmtorch.pruning.neighbors import neighbour_maps
from fmtorch.pruning.windows import (
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

# `refine_matches` for one pair, compiled


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
    are not independent. usual: that of an unrefined match of noise one, px. Noise grows with P^(-1/4).
    """

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
        """Raises ValueError for a window or a number of steps that is none."""
        if self.radius < 1 or self.iterations < 1 or not self.spacing > 0:
            raise ValueError(
                f"radius={self.radius}, iterations={self.iterations}, spacing={self.spacing}; radius and iterations "
                "must be at least 1, spacing above 0 px"
            )

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
            live = np.flatnonzero(_array(c.mask[pair]) & _finite(*arrays.values()))
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
        """The matches of one pair, all of them finite, refined."""
        n = len(rows["x0"])
        affine, side = (
            _frame_maps(rows["lafs0"], rows["lafs1"]) if "lafs0" in rows else (np.empty((n, 2, 2)), np.zeros(n))
        )
        if "lafs0" not in rows:
            neighbour_maps(rows["x0"], rows["x1"], affine)
        with np.errstate(all="ignore"):  # maps that are none: the kernel leaves what is not finite
            scale = np.sqrt(np.abs(affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0]))
            spacing = np.maximum(np.maximum(self.spacing, self.spacing / scale), self.share * side)
        windows = Windows(rows["x0"], rows["x1"], affine, spacing, np.ones(n, np.bool_))
        fit = Fit(
            self.radius, self.iterations, float(self.min_correlation), float(self.max_shift), float(self.max_deviation)
        )
        out = Refined(np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_))
        refine_windows(windows, Pyramid(*image0), Pyramid(*image1), fit, out)
        return out

    def _noise(self, out: Refined) -> Array:
        """Of those refined: the expected distance to the epipolar line, in that of a usual match.

        The point's covariance counts as if both points shared it: an error e of image 1 moves the Sampson distance by
        at most ``e / sqrt(1 + s^2)``, s the change of scale.
        """
        (xx, _, yy), affine = out.covariance[out.refined].T, out.affine[out.refined]
        area = np.abs(affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0])
        variance = (xx + yy) / (1 + area)
        noise: Array = np.sqrt(self.floor * self.floor + self.slope * self.slope * variance) / self.usual
        return noise

    def _doubt(self, prior: Tensor | None, pair: int, index: Tensor) -> Any:
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
    product: Array = a[:, :, :1] * b[:, :1, :] + a[:, :, 1:] * b[:, 1:, :]
    return product


def _array(tensor: Tensor) -> Array:
    tensor = tensor.detach().cpu()
    array: Array = (tensor.to(torch.float64) if tensor.is_floating_point() else tensor).contiguous().numpy()
    return array


def _finite(*arrays: Array) -> Array:
    """Of which matches (n,) all numbers are finite."""
    finite: Array = np.all([np.isfinite(array).all(tuple(range(1, array.ndim))) for array in arrays], 0)
    return finite


def _like(array: Array, tensor: Tensor) -> Tensor:
    return torch.from_numpy(array).to(tensor)

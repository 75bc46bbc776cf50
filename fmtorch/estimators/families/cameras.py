"""Two cameras of square pixels and central principal points: fundamental matrices by their parameters.

``E = U diag(1, 1, 0) V^T``, and F is E between the inverse calibrations. Focal lengths are logarithms in units of the
longer sides of the images.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2, F8x4
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import vector
from fmtorch.estimators.calibration import EXACT
from fmtorch.estimators.families.focal_prior import LOG_USUAL, FocalPrior, focal_prior, prior_slopes
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.arithmetic_kernels import exponential, logarithm
from fmtorch.geometry.pose_kernels import nearest_axes
from fmtorch.geometry.rank2_manifold_kernels import SQUARINGS, start_one

MIN_IMAGE_SIDE_PX = 16.0  # longer side of both images below which sizes are taken for those of another unit than pixels
MIN_FOCAL, MAX_FOCAL = 0.25, 5.0  # focal lengths outside, in units of the longer side, are not believed at the start


class Cameras(NamedTuple):
    """The cameras of k candidates: axes (k, 2, 3, 3), U and V, rows first; focal (k, 2), logarithms."""

    axes: F8x4
    focal: F8x2

    def of(self, k: int) -> Cameras:
        """Those of one candidate."""
        return Cameras(self.axes[k : k + 1], self.focal[k : k + 1])

    def joined(self, other: Cameras) -> Cameras:
        """The candidates of both."""
        return Cameras(np.concatenate([self.axes, other.axes]), np.concatenate([self.focal, other.focal]))

    def copy(self) -> Cameras:
        """The same in memory of its own."""
        return Cameras(self.axes.copy(), self.focal.copy())


def no_cameras(k: int) -> Cameras:
    """Room for the cameras of k candidates."""
    return Cameras(np.empty((k, 2, 3, 3)), np.empty((k, 2)))


class Images(NamedTuple):
    """Two images in normalised units. offset: (4,), from the points to those from the principal points. longest: (2,),
    the longer sides. prior: on the focal lengths."""

    offset: F8x1
    longest: F8x1
    prior: FocalPrior


def images_of(pair: Pair) -> Images:
    """The images of a pair whose sizes are known, computed once."""
    images: Images | None = pair.images.get("images")
    if images is None:
        images = pair.images["images"] = _images(pair)
    return images


def _images(pair: Pair) -> Images:
    unit, (h0, w0, h1, w1) = pair.pixels_per_unit, pair.sizes.tolist()
    sides = w0, h0, w1, h1
    # Half a pixel, of images in pixels; of sizes in another unit nobody knows what it is, and it is small.
    pixel = 0.0 if max(sides) < MIN_IMAGE_SIDE_PX else 1.0
    offset = np.array([(x - (side - pixel) / 2) / unit for x, side in zip(pair.centre.tolist(), sides, strict=True)])
    prior = focal_prior(pair.same_size)
    if (known := pair.calibration) is not None:
        measured = known.logarithms((max(h0, w0), max(h1, w1)))
        prior = focal_prior(pair.same_size, known.shared, measured, known.deviations)
    return Images(offset, np.array([max(h0, w0) / unit, max(h1, w1) / unit]), prior)


def focals_px(cameras: Cameras, pair: Pair) -> Array:
    """The focal lengths (2,) of the first candidate, px."""
    f0, f1 = cameras.focal[0].tolist()
    return np.array([exponential(f0), exponential(f1)]) * images_of(pair).longest * pair.pixels_per_unit


def focals_near(F: Array, pair: Pair) -> Array:
    """The focal lengths (2,) near a model (9,), px, by Bougnoux's formula; NaN of those that are measured."""
    cameras, calibration = no_cameras(1), pair.calibration
    nearest_cameras(F[None], images_of(pair), cameras)
    focals = focals_px(cameras, pair)
    return focals if calibration is None else np.where(np.isinf(calibration.deviations), focals, np.nan)


def focal_precision(focals: Array, pair: Pair) -> Array:
    """The second derivatives (2, 2) of the prior's cost by the logarithms of the focal lengths (2,), px.

    Infinite on the diagonal where a focal length is exactly known; one parameter that both share has the first place.
    """
    images, work = images_of(pair), np.empty(5)
    if pair.calibration is not None:
        focals = np.where(np.isnan(focals), pair.calibration.focals, focals)
    f0, f1 = (focals / (images.longest * pair.pixels_per_unit)).tolist()
    logarithms = np.array([logarithm(f0), logarithm(f1)])
    prior_slopes(logarithms, images.prior, work)
    precision = np.array([[work[2], work[4]], [work[4], 0.0 if images.prior.shared else work[3]]])
    if pair.calibration is not None:
        exact = np.array(pair.calibration.deviations) < EXACT
        np.fill_diagonal(precision, np.where(exact, np.inf, precision.diagonal()))
    return precision


class CentredMatches(NamedTuple):
    """Points (4, n) from the principal points; s2 (n,), squared scales of a loss in the unit of the points; precision
    (n,), one over these."""

    points: Array
    s2: Array
    precision: Array


def centred(pair: Pair, scale_px: float = 1.0) -> CentredMatches:
    """The matches of a pair whose image sizes are known, computed once. scale_px: of the loss."""
    return pair.cached(("centred", scale_px), lambda pair: _centred(pair, scale_px))


def _centred(pair: Pair, scale_px: float) -> CentredMatches:
    out = np.empty((6, pair.count))
    centre(pair.table, images_of(pair).offset, scale_px, out)
    return CentredMatches(out[:4], out[4], out[5])


@kernel(holds_gil=True)
def translate(F: F8x2, offset: F8x1, out: F8x2) -> None:
    """Models (k, 9) for points from which the offset (4,) is taken -> out (k, 9)."""
    for k in range(len(F)):
        for r in range(3):
            a, b = F[k, 3 * r], F[k, 3 * r + 1]
            out[k, 3 * r], out[k, 3 * r + 1] = a, b
            out[k, 3 * r + 2] = F[k, 3 * r + 2] + offset[0] * a + offset[1] * b
        for c in range(3):
            out[k, 6 + c] += offset[2] * out[k, c] + offset[3] * out[k, 3 + c]


@kernel(holds_gil=True)
def centre(table: F8x2, offset: F8x1, scale_px: float, out: F8x2) -> None:
    """Points from the principal points, squared scales of a loss, and one over these -> out (6, n).

    table: (9, n), of `Pair`. offset: (4,), what is added to points. scale_px: of the loss, of a usual match.
    """
    for i in range(table.shape[1]):
        for r in range(4):
            out[r, i] = table[r, i] + offset[r]
        scale = table[5, i]
        out[4, i], out[5, i] = (scale_px / scale) * (scale_px / scale), (scale / scale_px) * (scale / scale_px)


@kernel(holds_gil=True)
def nearest_cameras(F: F8x2, images: Images, cameras: Cameras) -> None:
    """Cameras near models (k, 9): those of their focal lengths, or of usual or measured ones where these are
    implausible; of exactly measured ones."""
    axes, focal, longest, shifted = cameras.axes, cameras.focal, images.longest, np.empty(F.shape)
    prior = images.prior
    measured = prior.precision[0] > 0 or prior.precision[1] > 0
    translate(F, -images.offset, shifted)
    G, M, e0, e1 = vector(9), vector(9), vector(3), vector(3)
    for k in range(len(shifted)):
        start_one(shifted[k], SQUARINGS, G, e0, e1)
        first = _squared_focal(G, 1, 3, e1) / (longest[0] * longest[0])
        second = _squared_focal(G, 3, 1, e0) / (longest[1] * longest[1])
        plausible0, plausible1 = MIN_FOCAL**2 < first < MAX_FOCAL**2, MIN_FOCAL**2 < second < MAX_FOCAL**2
        if not measured:  # one implausible focal length speaks against the other
            plausible0 = plausible0 and plausible1
            plausible1 = plausible0
        focal[k, 0] = logarithm(first) / 2 if plausible0 else LOG_USUAL
        focal[k, 1] = logarithm(second) / 2 if plausible1 else LOG_USUAL
        for i in range(2):
            plausible = plausible0 if i == 0 else plausible1
            if prior.precision[i] > 1 / EXACT**2 or (prior.precision[i] > 0 and not plausible):
                focal[k, i] = prior.measured[i]
        if prior.shared:
            focal[k, 0] = (focal[k, 0] + focal[k, 1]) / 2
            focal[k, 1] = focal[k, 0]
        d0 = 1 / (exponential(focal[k, 0]) * longest[0])
        d1 = 1 / (exponential(focal[k, 1]) * longest[1])
        for r in range(3):
            G[3 * r + 2] *= d0
        for c in range(3):
            G[6 + c] *= d1
        start_one(G, 0, M, e0, e1)
        nearest_axes(M, e0, e1, axes[k, 0], axes[k, 1])


@inner
def _squared_focal(F: Array, column: int, row: int, e: Array) -> Any:
    """Bougnoux's formula (ICCV 1998) for the camera whose points F's columns belong to; steps exchanged, the other."""
    r0 = -F[0] * e[1] + F[row] * e[0]
    r1 = -F[column] * e[1] + F[row + column] * e[0]
    r2 = -F[2 * column] * e[1] + F[row + 2 * column] * e[0]
    return -(r2 * F[8]) / (r0 * F[2 * row] + r1 * F[2 * row + column])

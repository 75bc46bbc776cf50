"""What the engine asks of a family of models.

Every model is a 3 x 3 matrix of nine entries that acts on a pair's normalised points, so that residuals, scores, pool
and stopping rule are written once; what differs is the family's: minimal samples, refinement, the fit.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from fmtorch.estimators.models.posterior import Cameras
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.arithmetic import exponential
from fmtorch.geometry.epipolar import TINY_OF_KERNEL, Residual, sampson_parts
from fmtorch.geometry.levenberg_marquardt import MATCH, Schedule, Weighted, in_rows
from fmtorch.geometry.pose import handedness
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel
from fmtorch.jit.lanes import absolute, added, fill, load, sqrt, where


class Hypotheses(NamedTuple):
    """Models of one round in the order of their draws: F (m, 9) float32, and the draw (m,) that each is made of.
    draw: counted from `start`. sample: (size, s), the matches of the draws start, start + 1, ..."""

    F: Array
    draw: Array
    sample: Array
    start: int


@runtime_checkable
class Family(Protocol):
    """A family of models. size: matches of a minimal sample."""

    size: ClassVar[int]

    def solve(self, pair: Pair, sample: Array, start: int) -> Hypotheses:
        """The models of the samples (size, s), which are the draws start, start + 1, ..."""
        ...


class FitScale(NamedTuple):
    """The last fit, at a pair's own noise.
    loss: its robust loss. sigmas_of_median: the standard deviation of a coordinate, in medians of inliers' residuals.
    scale_sigmas: the scale of the loss in these; it is within smallest_px and largest_px, and default_px where too few
    inliers tell the noise. by_prior: whether a match counts by its prior, too, not by its noise alone."""

    loss: str = "truncated"
    sigmas_of_median: float = 1.4826
    scale_sigmas: float = 2.0
    smallest_px: float = 0.3
    largest_px: float = 2.0
    default_px: float = 1.5
    by_prior: bool = True


@runtime_checkable
class Refining(Family, Protocol):
    """A family whose models can be refined and fitted on their own, and be estimates.
    model: what an estimate is called. residual: by which matches are judged."""

    model: ClassVar[str]
    residual: ClassVar[Residual]
    fit_scale: ClassVar[FitScale]

    def to_pixels(self, F: Array, pair: Pair, out: Array) -> bool:
        """A model (9,) of normalised points as that of pixels, of unit norm -> out (3, 3); whether it is finite."""
        ...

    def refine(self, F: Array, pair: Pair, loss: str, scale: float, schedule: Schedule) -> Array:
        """Models (k, 9) of least robust error nearby, on all matches by prior and noise; float64. One that cannot be
        refined is as it was. loss: of the Sampson distance, of `geometry.LOSSES`. scale: px, of a usual match."""
        ...

    def least_squares(self, F: Array, pair: Pair, weight: Array) -> Array:
        """The model (9,) fitted to weighted matches (n,); F (9,) where they determine none."""
        ...

    def step(self, F: Array, pair: Pair, weight: Array) -> Array:
        """The model (9,) after one Gauss-Newton step on weighted matches (n,); F (9,) where there is none."""
        ...


# On which side of both cameras matches lie: of the candidates of one pair

BITS = 20  # fractional, of the support, so that its sums are exact
REST = 1 / 26  # of the gain of Geman & McClure at 5 scales, from which on it is zero


@kernel(holds_gil=True)
def cheirality(cameras: Cameras, longest: F8x1, F: F8x2, matches: Weighted, tolerance: float, out: F8x1) -> None:
    """The share of the support that lies in front of both cameras, for the better of their poses -> out (k,).
    Support is each match's weight times the gain of Geman & McClure; matches of rays that are parallel up to the
    tolerance, in the unit of the points, lie on either side. longest: (2,), the longer sides of the images. F: (k, 9),
    the cameras' models. matches: from the principal points; their s2 is *one over* the square of each one's scale."""
    axes, focal = cameras.axes, cameras.focal
    rows, shift = in_rows(matches.points, matches.weight, matches.s2), 1.5 * 2.0 ** (52 - BITS)
    for k in range(len(out)):
        U, V, f = axes[k, 0], axes[k, 1], F[k]
        handed = handedness(U) * handedness(V)
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        total, front = fill(0.0), fill(0.0)
        back, mirrored, both = front, front, front
        for row in range(0, len(rows), MATCH):
            x0, y0, x1, y1 = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
            support = _gain(f, x0, y0, x1, y1, load(rows, row + 5)) * load(rows, row + 4) + shift - shift
            total += support
            a1, b1 = _ray(V, 0, x0, y0, d0), _ray(U, 0, x1, y1, d1)
            a2, b2 = _ray(V, 1, x0, y0, d0), _ray(U, 1, x1, y1, d1)
            a3, b3 = _ray(V, 2, x0, y0, d0), _ray(U, 2, x1, y1, d1)
            a, b, side = a1 * a1 + a2 * a2, b1 * b1 + b2 * b2, a1 * b2 - a2 * b1
            distance = b3 * absolute(side) - handed * a3 * b
            parallel = sqrt(b * (b + b3 * b3) * (a + a3 * a3)) * (tolerance / d1)
            ahead, behind = distance > -parallel, -distance > -parallel
            front += where(ahead & (side > 0.0), support, 0.0)
            back += where(behind & (side > 0.0), support, 0.0)
            mirrored += where(ahead & (side < 0.0), support, 0.0)
            both += where(behind & (side < 0.0), support, 0.0)
        largest, total_support = max(max(added(front), added(back)), max(added(mirrored), added(both))), added(total)
        out[k] = largest / total_support if total_support > 0 else math.nan


@inner
def _gain(f: Array, x0: Any, y0: Any, x1: Any, y1: Any, scale: Any) -> Any:
    """The gains of matches."""
    e, slope = sampson_parts(f, x0, y0, x1, y1)
    gain = 1.0 / (1.0 + e * e / where(slope > TINY_OF_KERNEL, slope, TINY_OF_KERNEL) * scale) - REST
    return where(gain > 0.0, gain, 0.0) * (1 / (1 - REST))


@inner
def _ray(M: Array, axis: int, x: Any, y: Any, depth: float) -> Any:
    """A component of points' rays in the axes of a camera."""
    return M[2, axis] + M[0, axis] / depth * x + M[1, axis] / depth * y

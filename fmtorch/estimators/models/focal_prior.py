"""How likely two focal lengths are: what they cost, and draws of them. All are logarithms, in units of the longer side.

Their mean is normal, and so is their difference, with a well at zero for images of one size: these mostly come from one
camera. A focal length that is measured (a calibration, EXIF) adds a term: quadratic where the measurement is exact,
else with a heavy tail, since what a file says may be of another crop, zoom or sensor. That mostly concerns both images,
which have one tail together: ``3 z^2 / (z^2 + 6)``, z^2 the sum of both squares."""

import functools
import math
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from fmtorch.estimators.pair import EXACT
from fmtorch.geometry.arithmetic import exponential
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel
from fmtorch.jit.random import random_bits, stream_state

USUAL_FOCAL = 1.2  # median focal length in units of the longer image side
FOCAL_DEVIATION = 0.4  # of its logarithm, averaged over the two images
RATIO_DEVIATION = 0.5  # of the logarithm of the two focal lengths' ratio, for images of different sizes
SAME_CAMERA_DEVIATION = 0.01  # width of the well for images of equal size
SAME_CAMERA_GAIN = 3.0  # its depth, in logarithms of the likelihood
SAME_CAMERA_SHARE = 0.6  # of the draws for images of equal size that have one focal length for both
LOG_USUAL = 0.1823215567939546  # math.log(USUAL_FOCAL)
MIN_DEVIATION = 1e-5  # that an exact measurement is taken to have
TAIL_GAIN = 3.0  # what measurements that may be wrong cost at most together, in logarithms of the likelihood
UNBELIEVED_SHARE = 0.6  # of the draws that leave out measurements with a tail
# On castle-P19 and fox focal lengths 1.5 times too long, given as 6 % off, have pose AUCs at 5 degrees of 59 and 30; of
# 39 and 20 with a tail of 5 for each image and a share of 0.2; of 63 and 36 if nothing is given. Right ones within 10 %
# have 74 and 57, and 76 and 57.
QUANTILES = 1 << 10  # of the normal distribution, from which focal lengths are drawn


class FocalPrior(NamedTuple):
    """The prior of one pair. same_size: whether the images may come from one camera. shared: whether they do.
    measured: (2,), logarithms; precision: (2,), one over the squares of their relative deviations, 0 of none.
    tail: (2,), whether a measurement may be wrong. normal: (QUANTILES,), quantiles of the normal distribution. draw:
    (5,), of the posterior of both given the measurements: means, and the factor (l00, l10, l11) of their covariance.
    common: (2,), mean and deviation of one focal length for both; share: of the draws that take it."""

    same_size: bool
    shared: bool
    measured: F8x1
    precision: F8x1
    tail: F8x1
    normal: F8x1
    draw: F8x1
    common: F8x1
    share: float


@functools.lru_cache(maxsize=1024)
def focal_prior(
    same_size: bool, shared: bool = False, measured: tuple[float, float] = (0.0, 0.0),
    deviation: tuple[float, float] = (math.inf, math.inf),
) -> FocalPrior:  # fmt: skip
    """The prior of a pair. measured: logarithms of focal lengths; deviation: of these, infinite where there is none."""
    m, s = np.array(measured), np.array(deviation)
    precision = 1 / np.maximum(s, MIN_DEVIATION) ** 2
    tail = ((s >= EXACT) & np.isfinite(s)).astype(np.float64)
    # In (mean, half of the difference) the prior is diagonal; of the two logarithms its precision is p00, p01, p00.
    a, b = FOCAL_DEVIATION**2, RATIO_DEVIATION**2 / 4
    determinant = (a + b) * (a + b) - (a - b) * (a - b)
    p00, p01 = (a + b) / determinant, -(a - b) / determinant
    q00, q11 = p00 + precision[0], p00 + precision[1]
    determinant = q00 * q11 - p01 * p01
    c00, c01, c11 = q11 / determinant, -p01 / determinant, q00 / determinant
    r0, r1 = (p00 + p01) * LOG_USUAL + precision[0] * m[0], (p00 + p01) * LOG_USUAL + precision[1] * m[1]
    l00 = math.sqrt(c00)
    l10 = c01 / l00
    draw = np.array([c00 * r0 + c01 * r1, c01 * r0 + c11 * r1, l00, l10, math.sqrt(max(c11 - l10 * l10, 0.0))])
    total = 1 / a + precision.sum()
    common = np.array([(LOG_USUAL / a + float((precision * m).sum())) / total, math.sqrt(1 / total)])
    share = 1.0 if shared else same_camera_share(m[0] - m[1], s) if same_size else 0.0
    return FocalPrior(same_size, shared, m, precision, tail, normal_quantiles(), draw, common, share)


def same_camera_share(difference: float, deviation: Array) -> float:
    """The share of draws with one focal length for images of equal size: how likely one camera is by Bayes' rule.
    difference: of the measured logarithms; deviation: (2,), of each."""
    if not np.isfinite(deviation).all():
        return SAME_CAMERA_SHARE
    if (deviation < EXACT).all():
        return 0.0  # draws have the measured focal lengths
    measured = float(np.square(deviation).sum())
    same, different = measured + SAME_CAMERA_DEVIATION**2, measured + RATIO_DEVIATION**2  # variances
    exponent = max(difference * difference / 2 * (1 / different - 1 / same), -40.0)
    odds = SAME_CAMERA_SHARE / (1 - SAME_CAMERA_SHARE) * math.sqrt(different / same)
    for _ in range(8):
        odds *= exponential(exponent / 8)
    return odds / (1 + odds)


@functools.cache
def normal_quantiles() -> Array:
    """QUANTILES quantiles of the normal distribution, rounded so that the last bits of a library's log do not count."""
    return np.rint([NormalDist().inv_cdf((i + 0.5) / QUANTILES) * 2.0**40 for i in range(QUANTILES)]) / 2.0**40


@inner
def focal_cost(focal: Array, prior: FocalPrior, out: Array) -> Any:
    """The cost of two log focal lengths; its gradient (2) and its Hessian (h00, h11, h01) -> out (5,).
    Of a shared focal length the first is the only parameter and the second, which is equal, stays where it is put."""
    difference = focal[0] - focal[1]
    squared = difference * difference
    mean = (focal[0] + focal[1]) * (0.5 / FOCAL_DEVIATION) - LOG_USUAL / FOCAL_DEVIATION
    well = (SAME_CAMERA_DEVIATION**2 if prior.same_size else 0.0) / (squared + SAME_CAMERA_DEVIATION**2)
    precision = 1 / RATIO_DEVIATION**2 + 2 * SAME_CAMERA_GAIN / SAME_CAMERA_DEVIATION**2 * well * well
    b = 0.5 / FOCAL_DEVIATION
    pull = precision * difference
    out[0], out[1] = b * mean + pull, b * mean - pull
    out[2], out[3], out[4] = b * b + precision, b * b + precision, b * b - precision
    cost = mean * mean / 2 + squared / (2 * RATIO_DEVIATION**2) - SAME_CAMERA_GAIN * well
    if prior.shared:
        cost = mean * mean / 2
        out[0], out[1], out[2], out[3], out[4] = 2 * b * mean, 0.0, 4 * b * b, 1.0, 0.0
    z2 = 0.0
    for i in range(2):
        if prior.tail[i] > 0:
            away = focal[i] - prior.measured[i]
            z2 += prior.precision[i] * away * away
    rest = 2 * TAIL_GAIN / (z2 + 2 * TAIL_GAIN)
    cost += TAIL_GAIN * z2 / (z2 + 2 * TAIL_GAIN)
    for i in range(2):
        j = 0 if prior.shared else i
        if prior.precision[i] > 0:
            away = focal[i] - prior.measured[i]
            if prior.tail[i] > 0:
                out[j] += prior.precision[i] * away * rest * rest
                out[2 + j] += prior.precision[i] * rest * rest
            else:
                cost += prior.precision[i] * away * away / 2
                out[j] += prior.precision[i] * away
                out[2 + j] += prior.precision[i]
    return cost


@kernel(holds_gil=True)
def draw_depths(prior: FocalPrior, longest: F8x1, mixed_seed: int, key: int, start: int, out: F8x2) -> None:
    """Focal lengths of both images for the draws start, start + 1, ..., in the unit of the points -> out (2, count).
    longest: (2,), the longer sides of the images. mixed_seed: of the seed and the stream."""
    normal, draw, common = prior.normal, prior.draw, prior.common
    state, mask, count = stream_state(mixed_seed, key), np.uint64(len(normal) - 1), len(normal)
    measured = prior.precision[0] > 0 or prior.precision[1] > 0
    unbelieved = UNBELIEVED_SHARE if prior.tail[0] > 0 or prior.tail[1] > 0 else 0.0
    for d in range(out.shape[1]):
        first = (start + d) * 3
        n0, n1 = normal[random_bits(state, first) & mask], normal[random_bits(state, first + 1) & mask]
        third = random_bits(state, first + 2)
        place, other = np.int64(third & mask), np.int64((third >> np.uint64(20)) & mask)
        f0 = LOG_USUAL + FOCAL_DEVIATION * n0
        half = RATIO_DEVIATION / 2 * n1
        if (prior.same_size or prior.shared) and place < prior.share * count:
            half = 0.0
        f0, f1 = f0 + half, f0 - half
        if measured and other >= unbelieved * count:
            if place < prior.share * count:
                f0 = common[0] + common[1] * n0
                f1 = f0
            else:
                f0, f1 = draw[0] + draw[2] * n0, draw[1] + draw[3] * n0 + draw[4] * n1
        out[0, d], out[1, d] = exponential(f0) * longest[0], exponential(f1) * longest[1]

"""How good a hypothesis is: the residual of every match under every model, turned into one number a model.

Per-match gains are rounded to few fractional bits, so that their sums are exact in any order. Larger is better."""

import functools
import math
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators.pair import Pair
from fmtorch.geometry.arithmetic import smallest_but
from fmtorch.geometry.epipolar import MATCH, SINGLES, TINY32, Residual, fill, load
from fmtorch.geometry.levenberg_marquardt import GAIN_TABLE
from fmtorch.jit.kernel import Array, F4x1, F4x2, F8x1, F8x2, I4x2, I8x1, Inner, Kernel, inner, kernel
from fmtorch.jit.lanes import added, sqrt, store, where


def fractional_bits(count: int) -> int:
    """Of so many float32 numbers in [0, 1], for their sums to be exact: 10, fewer beyond 2^14 numbers."""
    return min(10, 24 - (count - 1).bit_length())


def scored_matches(pair: Pair, threshold: float, prior_weighted: bool) -> Array:
    """The matches as kernels take them, for residuals in thresholds: (rows, SINGLES) float32."""
    rows = np.empty((rows_of(pair.count), SINGLES), np.float32)
    pack(pair.table, threshold, prior_weighted, rows)
    return rows


def rows_of(count: int) -> int:
    """Rows of so many matches: MATCH for each SINGLES of them."""
    return (count + SINGLES - 1) // SINGLES * MATCH


@kernel(holds_gil=True)
def pack(table: F8x2, threshold: float, weighted: bool, rows: F4x2) -> None:
    """SINGLES matches in MATCH rows each -> rows; those that fill the last ones have no weight.
    table: (9, n), of `Pair`. weighted: by the prior. The scale of a match is one over the square of its threshold."""
    n = table.shape[1]
    for first in range(0, n, SINGLES):
        row = first // SINGLES * MATCH
        for i in range(SINGLES):
            for k in range(4):
                rows[row + k, i] = table[k, first + i] if first + i < n else 0.0
            scale = table[5, first + i] / threshold if first + i < n else 0.0
            rows[row + 4, i] = scale * scale
            weight = table[6, first + i] if weighted and first + i < n else 1.0
            rows[row + 5, i] = weight if first + i < n else 0.0


COUNT, TRUNCATED_SQUARES, GEMAN_MCCLURE, TABLE = 0, 1, 2, 3  # gains
ONE, ZERO = np.float32(1), np.float32(0)
REST = np.float32(1 / 26)  # of the gain of Geman & McClure at 5 scales, from which on it is zero
STRETCH = np.float32(1 / (1 - 1 / 26))
NO_TABLE = np.empty(0, np.float32)


@runtime_checkable
class Score(Protocol):
    """Scores models. prior_weighted: each match counts as much as its prior, where it has one.

    One may have a `preselection`, another score by which models are compared on few matches."""

    prior_weighted: bool

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        """Scores (k,) float64 of those of the models (m, 9), float32, that have the indices `which` (k,) int64.
        Models are of the pair's points in normalised units."""
        ...


class Gain(NamedTuple):
    """A gain as kernels take it. bits: fractional, that gains are rounded to. table: of TABLE, over the squared
    residual from 0 to the threshold; 0 at its end."""

    code: int
    bits: int
    table: F4x1


class SummedGains:
    """The sum over matches of a gain, from 1 at no residual to 0, times P(inlier) if so asked.

    A score of one's own overrides `gain` in NumPy, or names a compiled `gain_kernel(squared, out)`; residuals and the
    exact sum are compiled in any case. threshold: the scale of the residuals, Sampson distance, px."""

    gain_kernel: ClassVar[Kernel[..., None] | None] = None
    CODE: ClassVar[int | None] = None  # of a gain that one kernel computes
    table = NO_TABLE

    def __init__(self, threshold: float, prior_weighted: bool = False) -> None:
        if not threshold > 0:
            raise ValueError(f"threshold is {threshold}; it is a distance in pixels and must be positive")
        self.threshold, self.prior_weighted = float(threshold), prior_weighted

    def at(self, threshold: float) -> "SummedGains":
        """The same score at another threshold, px."""
        return type(self)(threshold, self.prior_weighted)

    def gain(self, squared: Array) -> Array:
        """Gains in [0, 1] at squared residuals in thresholds, (models, matches) float32."""
        raise NotImplementedError(f"{type(self).__name__} must override `gain` or name a `gain_kernel`")

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        (rows, gain), out = pair.cached(self, self._matches), np.empty(len(which))
        if self.CODE is not None:
            score_gains_of(pair.residual)(F, which, rows, gain, out)
            return out
        squared = np.empty((len(which), pair.count), np.float32)
        squared_residuals_of(pair.residual)(F, which, rows, squared)
        if self.gain_kernel is not None:
            gains = np.empty_like(squared)
            self.gain_kernel(squared, gains)
        else:
            gains = np.asarray(self.gain(squared))
        numbers = gains.shape == squared.shape and gains.dtype.kind in "biuf"
        if not numbers or np.isnan(gains[squared < np.inf]).any():
            raise ValueError(
                f"{type(self).__name__}.gain returns shape {gains.shape} of {gains.dtype}; it must be the shape of its "
                f"argument, {squared.shape}: (models, matches), of numbers"
            )
        sum_gains(np.ascontiguousarray(gains, np.float32), rows, gain.bits, out)
        return out

    def _matches(self, pair: Pair) -> tuple[Array, Gain]:
        gain = Gain(self.CODE or 0, fractional_bits(pair.count), self.table)
        return scored_matches(pair, self.threshold, self.prior_weighted), gain


class InlierCount(SummedGains):
    """RANSAC: the number of matches within the threshold (Fischler & Bolles 1981)."""

    CODE = COUNT


class Msac(SummedGains):
    """MSAC: the sum of ``1 - r^2 / t^2`` over the matches within the threshold t (Torr & Zisserman 2000)."""

    CODE = TRUNCATED_SQUARES


class GemanMcClure(SummedGains):
    """The sum over matches of ``1 / (1 + r^2 / s^2)``, shifted and scaled to be 1 at r = 0 and 0 from 5 s on.

    Geman & McClure (1987); s is the threshold. A narrow peak with a long tail: exact matches decide, and matches with
    larger noise still count, so that one scale serves scenes of different noise."""

    CODE = GEMAN_MCCLURE


class Magsac(SummedGains):
    """MAGSAC++: the likelihood marginalised over the noise scale (Barath et al., CVPR 2020, section 3.2).

    The gain is ``1 - rho(r) / rho(k sigma_max)``, rho as in `magsac`, tabulated over r^2 as the authors do.
    threshold: k sigma_max, Sampson distance, px."""

    CODE, table = TABLE, GAIN_TABLE


def scored(score: Score, F: Array, which: Array, pair: Pair) -> Array:
    """What a score says of models F[which] (k,), float64; ValueError where that is not one number for each."""
    scores = score(F, which, pair)
    if not isinstance(scores, np.ndarray) or scores.shape != which.shape or scores.dtype != np.float64:
        what = f"{scores.dtype} {scores.shape}" if isinstance(scores, np.ndarray) else type(scores).__name__
        wanted = f"an array of float64 {which.shape}: one number a model"
        raise ValueError(f"{type(score).__name__} returns {what}; it must be {wanted}")
    return np.ascontiguousarray(scores)


@functools.cache
def row_of(residual: Residual) -> Inner[..., Any]:
    """Squared residuals of SINGLES matches under a model f, float32, times their scale, of rows from `row` on."""
    of_lanes = residual.of_lanes

    @inner
    def of_row(f: Array, rows: Array, row: int) -> Any:
        x0, y0, x1, y1 = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
        return of_lanes(f, x0, y0, x1, y1) * load(rows, row + 4)

    return of_row


@functools.cache
def score_gains_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of sums of gains for a residual."""
    of_row = row_of(residual)

    @kernel(name=f"score_gains_{residual.name}")
    def score_gains(F: F4x2, which: I8x1, rows: F4x2, gain: Gain, out: F8x1) -> None:
        """Sums of gains of the models F[which] -> out (k,)."""
        shift = np.float32(1.5 * 2.0 ** (23 - gain.bits))
        gains = np.empty((len(rows) // MATCH, SINGLES), np.float32)
        for k in range(len(which)):
            total = fill(ZERO)
            for row in range(0, len(rows), MATCH):
                g = of_row(F[which[k]], rows, row)
                if gain.code == COUNT:
                    g = where(g <= ONE, fill(ONE), ZERO)
                elif gain.code == TRUNCATED_SQUARES:
                    g = ONE - g
                elif gain.code == GEMAN_MCCLURE:
                    g = geman_mcclure(g)
                store(gains, row // MATCH, g)
            if gain.code == TABLE:
                _look_up(gains.ravel(), gain.table)
            for row in range(len(gains)):
                total += rounded(load(gains, row) * load(rows, MATCH * row + 5), shift)
            out[k] = added(total)

    return score_gains


@functools.cache
def squared_residuals_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of squared residuals in thresholds, for gains in NumPy."""
    of_row = row_of(residual)

    @kernel(name=f"squared_residuals_{residual.name}")
    def squared_residuals(F: F4x2, which: I8x1, rows: F4x2, out: F4x2) -> None:
        """Squared residuals in thresholds of n matches under the models F[which] -> out (k, n)."""
        lane = np.empty((1, SINGLES), np.float32)
        for k in range(len(which)):
            for row in range(0, len(rows), MATCH):
                store(lane, 0, of_row(F[which[k]], rows, row))
                first = row // MATCH * SINGLES
                for i in range(min(SINGLES, out.shape[1] - first)):
                    out[k, first + i] = lane[0, i]

    return squared_residuals


@kernel
def sum_gains(gains: F4x2, rows: F4x2, bits: int, out: F8x1) -> None:
    """Sums of the gains (k, n), each times the weight of its match, rounded to so many bits -> out (k,)."""
    shift = np.float32(1.5 * 2.0 ** (23 - bits))
    for k in range(len(out)):
        total: Any = 0.0
        for i in range(gains.shape[1]):
            gain = gains[k, i] * rows[i // SINGLES * MATCH + 5, i % SINGLES]
            total += (gain if gain > ZERO else ZERO) + shift - shift
        out[k] = total


@inner
def _look_up(r2: Array, table: Array) -> None:
    """The entries of a table at squared residuals, in place."""
    last = np.float32(len(table) - 1)
    for i in range(len(r2)):
        entry = r2[i] * last
        r2[i] = table[np.int32(entry if entry < last else last)]


@inner
def geman_mcclure(r2: Any) -> Any:
    """The gain of Geman & McClure of squared residuals."""
    g = ONE / (r2 + ONE) - REST
    return where(g > ZERO, g, ZERO) * STRETCH


@inner
def rounded(gain: Any, shift: Any) -> Any:
    """Gains rounded to even multiples of what the shift, 1.5 2^(23 - bits), allows; what is not a number is zero."""
    return where(gain > ZERO, gain, ZERO) + shift - shift


# A score that saturates where matches crowd, so that no single textured plane outvotes the rest of the image

GRID = 12  # cells along each side of each image


class SaturatedGains(SummedGains):
    """The sum over grid cells of ``sqrt(sum of P g(r))``, over both images; g is the gain of Geman & McClure.

    Saturates where matches crowd, so that a model which explains the whole image beats one that explains a single
    textured plane. The narrow peak of g tells exact models from those nearby, and its tail lets one scale serve scenes
    of different noise. The grid is that of the box around the matches of weight. threshold: the scale, at which a match
    counts half, Sampson distance, px. preselection: the plain sum of g, for few matches."""

    def __init__(self, threshold: float, prior_weighted: bool = True) -> None:
        super().__init__(threshold, prior_weighted)
        self.preselection = GemanMcClure(threshold, prior_weighted)

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        rows, gain = pair.cached(self, self._matches)
        cells = pair.cached(("cells", self.prior_weighted), self._cells)
        out = np.empty(len(which))
        score_saturated_of(pair.residual)(F, which, rows, cells, gain.bits, out)
        return out

    def _cells(self, pair: Pair) -> Array:
        cells = np.empty((2, pair.count), np.int32)
        saturated_cells(pair.table, self.prior_weighted, cells)
        return cells


@functools.cache
def score_saturated_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of saturated gains for a residual."""
    of_lanes = residual.of_lanes

    @kernel(name=f"score_saturated_{residual.name}")
    def score_saturated(F: F4x2, which: I8x1, rows: F4x2, cells: I4x2, bits: int, out: F8x1) -> None:
        """Sums over the cells of both images of roots of summed gains of Geman & McClure -> out (k,), of SINGLES
        models at a time. rows: the matches. cells: of `saturated_cells`. bits: fractional, of gains and roots."""
        shift = np.float32(1.5 * 2.0 ** (23 - bits))
        models, total = np.zeros((9, SINGLES), np.float32), np.empty((1, SINGLES), np.float32)
        sums = np.empty((2 * GRID * GRID, SINGLES), np.float32)
        for first in range(0, len(which), SINGLES):
            count = min(SINGLES, len(which) - first)
            for k in range(count):
                for q in range(9):
                    models[q, k] = F[which[first + k], q]
            f = (
                load(models, 0), load(models, 1), load(models, 2), load(models, 3), load(models, 4),
                load(models, 5), load(models, 6), load(models, 7), load(models, 8),
            )  # fmt: skip
            for cell in range(len(sums)):
                store(sums, cell, fill(ZERO))
            for i in range(cells.shape[1]):
                row, lane, a, b = i // SINGLES * MATCH, i % SINGLES, cells[0, i], cells[1, i]
                r2 = of_lanes(f, rows[row, lane], rows[row + 1, lane], rows[row + 2, lane], rows[row + 3, lane])
                g = rounded(geman_mcclure(r2 * rows[row + 4, lane]) * rows[row + 5, lane], shift)
                store(sums, a, load(sums, a) + g)
                store(sums, b, load(sums, b) + g)
            of_models = fill(ZERO)
            for cell in range(len(sums)):
                of_models += rounded(sqrt(load(sums, cell)), shift)
            store(total, 0, of_models)
            for k in range(count):
                out[first + k] = total[0, k]

    return score_saturated


@kernel(holds_gil=True)
def saturated_cells(table: F8x2, weighted: bool, out: I4x2) -> None:
    """Each match's cells in grids over the matches of weight -> out (2, n), of image 0 and, counted on, of image 1.
    table: (9, n), of `Pair`. weighted: by the prior."""
    for image in range(2):
        out[image] = image * GRID * GRID
        for axis in range(2):
            x, low, high = table[2 * image + axis].astype(np.float32), np.float32(math.inf), np.float32(-math.inf)
            for i in range(len(x)):
                if not weighted or np.float32(table[6, i]) > ZERO:
                    low, high = min(low, x[i]), max(high, x[i])
            for i in range(len(x)):
                share = (x[i] - low) / max(high - low, TINY32) * np.float32(GRID)
                cell = np.int32(min(max(share, ZERO), np.float32(GRID - 1))) if math.isfinite(share) else np.int32(0)
                out[image, i] += cell * (GRID if axis else 1)


BIN_SHIFT, BINS = 21, 1 << 10  # of a float32 the exponent and two bits more


class Median:
    """LMedS: minus the median squared residual, of an even number the lower middle one (Rousseeuw 1984)."""

    prior_weighted = False

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        out = np.empty(len(which))
        score_median_of(pair.residual)(F, which, pair.cached("rows of ones", _rows), pair.count, out)
        return out


def _rows(pair: Pair) -> Array:
    rows = scored_matches(pair, 1.0, False)
    rows[4::MATCH] = 1
    return rows


@functools.cache
def score_median_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of medians for a residual."""
    of_row = row_of(residual)

    @kernel(name=f"score_median_{residual.name}")
    def score_median(F: F4x2, which: I8x1, rows: F4x2, count: int, out: F8x1) -> None:
        """Minus the median squared residual of so many matches under the models F[which] -> out (k,)."""
        values = np.empty(count + 1, np.float32)
        r2, counts = np.empty((len(rows) // MATCH, SINGLES), np.float32), np.empty(BINS, np.int32)
        for k in range(len(which)):
            for row in range(0, len(rows), MATCH):
                store(r2, row // MATCH, of_row(F[which[k]], rows, row))
            out[k] = -_smallest(r2.ravel()[:count], counts, values, (count + 1) // 2)

    return score_median


@inner
def _smallest(values: Array, counts: Array, of_bin: Array, rank: int) -> Any:
    """The value of a rank, from 1, in ascending order, of numbers that are not negative; NaN counts as infinite.
    counts: (BINS,), of_bin: (n + 1,), for the work. First the bin of the value is found, by its upper bits."""
    for i in range(len(values)):
        values[i] = values[i] if values[i] == values[i] else np.float32(math.inf)
    bits = values.view(np.int32)
    for b in range(BINS):
        counts[b] = 0
    for i in range(len(values)):
        counts[bits[i] >> BIN_SHIFT] += 1
    wanted, left = 0, rank
    while counts[wanted] < left:
        left -= counts[wanted]
        wanted += 1
    m = 0
    for i in range(len(values)):
        of_bin[m] = values[i]
        m += (bits[i] >> BIN_SHIFT) == wanted
    return smallest_but(of_bin, 0, m, left - 1)

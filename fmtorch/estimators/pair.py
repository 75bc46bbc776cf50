"""One pair as estimators see it: its usable matches in normalised units, without padding or neighbours."""

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fmtorch.geometry.arithmetic import logarithm_kernel
from fmtorch.geometry.epipolar import SAMPSON, Residual, homography_stretch, mean_stretch, stretch_across
from fmtorch.geometry.matrices import multiply
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, inner, kernel, vector
from fmtorch.jit.random import Stream, mixed_seed, stream_state, uniform_kernel

T = TypeVar("T")
MAX_COORDINATE_PX = 1e100  # a match beyond is none: numbers made of its coordinates would overflow
MIN_NOISE, MAX_NOISE = 0.1, 10.0  # of a match, relative to a usual one; what is beyond is taken for these
SMALLEST_BUCKET = 128
MATCH_WEIGHT, STRETCH = 6, 9  # rows of a pair's table
EXACT = 0.02  # relative deviation below which a focal length counts as exactly known


class Calibration(NamedTuple):
    """Measured focal lengths of two images of square pixels and central principal points.
    focals: px. deviations: relative standard deviations, 0 of a calibration, infinite where a focal length is unknown.
    shared: whether both are one, in units of the longer sides of the images."""

    focals: tuple[float, float]
    deviations: tuple[float, float]
    shared: bool

    @property
    def exact(self) -> bool:
        """Whether both are exactly known."""
        return max(self.deviations) < EXACT

    def logarithms(self, longest: tuple[float, float]) -> tuple[float, float]:
        """Of the focal lengths in units of the longer sides (px); 0 of unknown ones."""
        f0, f1 = (
            float(logarithm_kernel(f / side)) if math.isfinite(s) else 0.0
            for f, s, side in zip(self.focals, self.deviations, longest, strict=True)
        )
        return f0, f1


def calibration_of(focal: Array, shared: bool) -> Calibration | None:
    """The calibration of a pair from a row of `Correspondences.focal` (2, 2); None where nothing is known."""
    (f0, s0), (f1, s1) = focal.tolist()
    if not shared and math.isinf(s0) and math.isinf(s1):
        return None
    return Calibration((f0, f1), (s0, s1), shared)


class Lens(NamedTuple):
    """What is known of the lenses of two images, lambda of the division model in half diagonals.
    deviations: 0 of exactly known ones, infinite of unknown ones. shared: whether both are one."""

    means: tuple[float, float]
    deviations: tuple[float, float]
    shared: bool


class Pair:
    """The matches of one pair. Arrays are float64 and C-contiguous.

    table: (9, n), a row each of x0, y0, x1, y1 in normalised units, weight, pixels per noise, match weight, noise,
    ambiguity; of undistorted points also by how much their distances are longer than in the photographs, and their
    eight derivatives by those. points: the first four: ``x = centre + pixels_per_unit * point``. weight: what each
    match counts in a fit, its prior divided by the square of its noise. pixels_per_noise: pixels in one normalised
    unit, divided by the noise. match_weight: what it counts in a score, the prior, or one. prior, noise, ambiguity:
    (n,), None where the caller has none; noise, in photographs, is between MIN_NOISE and MAX_NOISE. bucket: of the
    number of matches of the whole pair, which decides how priors are quantised and whether models are preselected.
    pixels_per_unit: a power of two. centre: (4,), of the points, pixels. sizes: (4,), of the images as h, w, h, w,
    pixels; empty where unknown. key, seed: of every random choice. residual: of the family of models, by which matches
    are judged. calibration: what is known of the focal lengths, of a pair whose sizes are known; lens: of the lenses,
    None of pinholes. images: what families compute of the images, for all subsets of the matches."""

    def __init__(
        self, table: Array, known: tuple[bool, bool, bool], bucket: int, pixels_per_unit: float, key: int, seed: int,
        centre: Array, sizes: Array, residual: Residual = SAMPSON, calibration: Calibration | None = None,
        images: dict[Hashable, Any] | None = None, lens: Lens | None = None,
    ) -> None:  # fmt: skip
        """known: whether the caller has given a prior, noise, ambiguity."""
        self.table, self.known, self.bucket, self.pixels_per_unit = table, known, bucket, pixels_per_unit
        self.key, self.seed, self.centre, self.sizes, self.residual = key, seed, centre, sizes, residual
        self.calibration, self.lens = calibration, lens
        self.count = table.shape[1]
        self.points, self.weight = table[:4], table[4]
        self.pixels_per_noise, self.match_weight = table[5], table[MATCH_WEIGHT]
        self.prior: Array | None = self.match_weight if known[0] else None
        self.noise: Array | None = table[7] if known[1] else None
        self.ambiguity: Array | None = table[8] if known[2] else None
        self.images: dict[Hashable, Any] = {} if images is None else images
        self._cache: dict[Hashable, Any] = {}

    @property
    def sizes_known(self) -> bool:
        """Whether the sizes of the images are known."""
        return len(self.sizes) > 0

    @property
    def same_size(self) -> bool:
        """Whether both images have one size, upright or turned. Of a pair whose sizes are known."""
        h0, w0, h1, w1 = self.sizes.tolist()
        return bool(sorted((h0, w0)) == sorted((h1, w1)))

    @property
    def noises(self) -> Array:
        """The noise of each match (n,), ones where none is known."""
        noises: Array = self.table[7]
        return noises

    @property
    def stretch(self) -> Array | None:
        """By how much distances are stretched (n,), None where points are the photographs' own."""
        return self.table[STRETCH] if len(self.table) > STRETCH else None

    @property
    def points32(self) -> Array:
        """The points as scores take them, float32."""
        return self.cached("points32", lambda pair: pair.points.astype(np.float32))

    def cached(self, name: Hashable, compute: Callable[["Pair"], T]) -> T:
        """What a part computes of all these matches, and needs again."""
        value: T | None = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    def mixed_seed(self, stream: Stream) -> int:
        """The seed of a stream of random numbers, as kernels take it."""
        return mixed_seed(self.seed, stream)

    def uniform(self, start: int, count: int, columns: int) -> Array:
        """Random numbers in [0, 1) for the draws start .. start + count - 1, (count, columns).
        A function of (seed, key, draw, column): the same in any batch and in any order of draws."""
        out = np.empty((count, columns))
        uniforms(self.mixed_seed(Stream.SAMPLING), self.key, start, out)
        return out

    def take(self, index: Array) -> "Pair":
        """The same pair with the matches of these indices."""
        return self.with_table(self.table.take(index, 1), self.known, self.lens)

    def ignoring(self, wrong: Array) -> "Pair":
        """The same pair, matches of which (n,) count nowhere."""
        table = self.table.copy()
        table[4, wrong] = table[MATCH_WEIGHT, wrong] = 0
        return self.with_table(table, (True, *self.known[1:]), self.lens)

    def reduced(self, times: int) -> "Pair":
        """The pair as it were if its photographs were reduced so many times: distances are as many pixels fewer."""
        table = self.table.copy()
        table[5] /= times
        return Pair(
            table, self.known, self.bucket, self.pixels_per_unit / times, self.key, self.seed, self.centre / times,
            self.sizes / times, self.residual, self.calibration, self.images, self.lens,
        )  # fmt: skip

    def with_table(self, table: Array, known: tuple[bool, bool, bool], lens: Lens | None) -> "Pair":
        """The same pair with another table."""
        return Pair(
            table, known, self.bucket, self.pixels_per_unit, self.key, self.seed, self.centre, self.sizes,
            self.residual, self.calibration, self.images, lens,
        )  # fmt: skip


def stretched(pair: Pair, J: Array) -> Pair:
    """The pair of undistorted points, whose derivatives by the photographs' are J (n, 2, 2, 2)."""
    table = np.concatenate([pair.table, np.ones((1, pair.count)), J.reshape(-1, 8).T])
    return _stretched_by(pair.with_table(table, pair.known, pair.lens), mean_stretch(J))


def across_lines(pair: Pair, F: Array) -> Pair:
    """The pair whose distances count by how points are stretched across a model's (9,) lines, or towards its points."""
    if pair.stretch is None:
        return pair
    J = pair.table[STRETCH + 1 :].T.reshape(-1, 2, 2, 2)
    stretch = stretch_across if pair.residual is SAMPSON else homography_stretch
    return _stretched_by(pair, np.sqrt(stretch(F, pair.points, J)))


def _stretched_by(pair: Pair, stretch: Array) -> Pair:
    table = pair.table.copy()
    more = stretch / table[STRETCH]
    table[4], table[5], table[7], table[STRETCH] = table[4] / (more * more), table[5] / more, table[7] * more, stretch
    return pair.with_table(table, (pair.known[0], True, pair.known[2]), pair.lens)


class PixelMatches(NamedTuple):
    """One pair as it arrives: matches in pixels (n, 2), which are real (n,), and what is known of each; else empty.
    sizes: (4,), of the images as h, w, h, w."""

    x0: F8x2
    x1: F8x2
    mask: B1x1
    prior: F8x1
    noise: F8x1
    ambiguity: F8x1
    sizes: F8x1


def bucket(count: int) -> int:
    """The smallest of 128, 192, 256, 384, 512, ... that holds `count` matches."""
    power = max(SMALLEST_BUCKET, 1 << max(count - 1, 0).bit_length())
    return power * 3 // 4 if count <= power * 3 // 4 and power > SMALLEST_BUCKET else power


def squared(value: float) -> float:
    """The square; infinite beyond the range of a float, where ``**`` of a Python float raises."""
    return value * value


@kernel(holds_gil=True)
def normalize_pair(matches: PixelMatches, slot: I8x1, table: F8x1, frame: F8x1) -> int:
    """Where the usable ones of n matches stand -> slot (m,); what is known of them -> the first 9 m of table; m.

    table: (9 n,), the rows of `Pair` one after the other. frame: (6,), the middle of the box around the points of each
    image; the unit in pixels, 0 where all coincide; and 1 where all priors, noises and sizes are right, otherwise 0."""
    x0, x1, mask, prior, noise, ambiguity, sizes = matches
    count, half, end, right = 0, 0.0, MAX_COORDINATE_PX, True
    for i in range(len(mask)):
        if mask[i] and abs(x0[i, 0]) < end and abs(x0[i, 1]) < end and abs(x1[i, 0]) < end and abs(x1[i, 1]) < end:
            slot[count] = i
            count += 1
    for r in range(4):
        x, low, high = x0 if r < 2 else x1, math.inf, -math.inf
        for i in range(count):
            value = x[slot[i], r % 2]
            table[r * count + i] = value
            low, high = min(low, value), max(high, value)
        frame[r], half = (low + high) / 2, max(half, (high - low) / 2)
    unit = power_of_two(half) if half > 0 else 0.0
    for r in range(4 if half > 0 else 0):
        for i in range(r * count, (r + 1) * count):
            table[i] = (table[i] - frame[r]) / unit
    for i in range(count):
        k = slot[i]
        p, s = prior[k] if len(prior) else 1.0, noise[k] if len(noise) else 1.0
        right = right and 0 <= p <= 1 and s > 0
        s = min(max(s, MIN_NOISE), MAX_NOISE)
        table[4 * count + i], table[5 * count + i] = p / (s * s), unit / s
        table[6 * count + i], table[7 * count + i] = p, s
        table[8 * count + i] = ambiguity[k] if len(ambiguity) else 0.0
    for side in sizes:
        right = right and 0 < side < math.inf
    frame[4], frame[5] = unit, 1.0 if right else 0.0
    return count


@inner
def power_of_two(half: float) -> Any:
    """The least power of two that is not smaller, as `PixelFrame.around`."""
    mantissa, exponent = math.frexp(max(half, 1e-300))
    return math.ldexp(1.0, exponent - (1 if mantissa == 0.5 else 0))


@kernel(holds_gil=True)
def to_pixels(F: F8x1, centre: F8x1, unit: float, out: F8x2) -> bool:
    """A model (9,) of normalised points as that of pixels, canonical in scale and sign -> out (3, 3); if it is finite.
    centre: (4,), of the points in pixels; unit: pixels in one unit of the points."""
    T0, T1, product, flat = vector(9), vector(9), vector(9), out.ravel()
    for i in range(3):
        for j in range(3):
            diagonal = (1.0 if i == 2 else 1 / unit) if i == j else 0.0
            T0[3 * i + j] = -centre[i] / unit if i < j == 2 else diagonal
            T1[3 * i + j] = -centre[2 + j] / unit if j < i == 2 else diagonal  # transposed
    multiply(T1, F, product)
    multiply(product, T0, flat)
    largest, total, finite = flat[0], 0.0, True
    for i in range(9):
        largest = flat[i] if abs(flat[i]) > abs(largest) else largest
    peak = abs(largest) if largest != 0 else 1.0
    for i in range(9):
        flat[i] /= peak
        total += flat[i] * flat[i]
    scale, sign = 1 / math.sqrt(total) if total != 0 else 0.0, math.copysign(1.0, largest)
    for i in range(9):
        flat[i] = flat[i] * scale * sign
        finite = finite and math.isfinite(flat[i])
    return finite


@kernel(holds_gil=True)
def uniforms(mixed_seed: int, key: int, start: int, out: F8x2) -> None:
    """Random numbers in [0, 1), those of draw start + i -> out[i]."""
    state, columns = stream_state(mixed_seed, key), out.shape[1]
    for i in range(len(out)):
        for j in range(columns):
            out[i, j] = uniform_kernel(state, (start + i) * columns + j)

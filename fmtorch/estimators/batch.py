"""From a batch of correspondences to one pair after the other, and from their solutions to estimates.

Pairs are estimated on the host, whatever device the caller's tensors are on, and shared out among threads, which
changes no result. What stands beside a pair in the batch is never looked at."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from fmtorch.core.types import DEVIATION, FOCAL, PROBABILITY, SIZE, Correspondences, Estimate
from fmtorch.estimators.gradients import Attach, Solved, with_gradients
from fmtorch.estimators.lens_search import undistorted
from fmtorch.estimators.models.fundamental import Matrices
from fmtorch.estimators.models.posterior import focal_precision, focals_near, focals_px
from fmtorch.estimators.pair import Lens, Pair, PixelMatches, bucket, calibration_of, normalize_pair, stretched
from fmtorch.estimators.preselection import degenerate_support
from fmtorch.estimators.refinement import Fit, scale_of
from fmtorch.geometry.epipolar import SAMPSON, Residual, mean_stretch
from fmtorch.geometry.significance import of_one_pair
from fmtorch.jit.kernel import Array, as_array
from fmtorch.jobs.execution import available

PARTS_OF_A_THREAD = 4  # so that no thread is long alone at the end
MIN_WORK = 500  # matches: a pair of fewer takes as long as one of these
NOT_SOLVED = "every minimal sample was degenerate"
NOT_FINITE = "the final fit is not finite"
NO_SIZES = "a lens needs the image sizes"
MAX_LENS_DEVIATION = 0.1  # standard deviation above which matches do not determine a lens


class Solution(NamedTuple):
    """What an estimator says of one pair: the fit, None with a reason where there is none; samples drawn; inliers;
    lenses (2,) and their standard deviations (2,), None where they are not estimated; of pinholes, the lens that the
    matches suggest, NaN where they agree with these."""

    fit: Fit | None
    samples: int
    inliers: Array | None = None
    reason: str = ""
    pair: Pair | None = None
    lens: Array | None = None
    deviation: Array | None = None
    lens_suggested: float = math.nan


class Row(NamedTuple):
    """A pair of a batch that can be tried: its place there, and its matches as they came.
    slot: (n,), where the pair's matches are among these. needed: inliers below which a model is none."""

    place: int
    matches: PixelMatches
    pair: Pair
    slot: Array
    needed: int


class Estimation:
    """The estimation of a batch of pairs on the host: the pairs, and the estimates that become of them.
    family: of the models. minimal: matches below which a pair is not tried, and inliers below which a model is none.
    calibrated: the same of a pair whose focal lengths are exactly known; None: cameras make no difference."""

    def __init__(
        self, c: Correspondences, seed: int, family: Matrices, minimal: int, calibrated: int | None = None
    ) -> None:
        host = c if c.mask.device.type == "cpu" else c.detach().to("cpu")
        b, n = c.mask.shape
        self.c, self.seed, self.family, self.batch = c, seed, family, Batch.of(host)
        self.minimal, self.calibrated = minimal, minimal if calibrated is None else calibrated
        self.parts = [part.tolist() for part in shared_out(host)] if b > 1 and available() > 1 else [range(b)]
        """The rows, shared out among threads."""
        self.F, self.inliers, self.ok = np.zeros((b, 3, 3)), np.zeros((b, n), np.bool_), np.zeros(b, np.bool_)
        self.samples, self.significance, self.reasons = np.zeros(b, np.int64), np.full(b, -np.inf), [""] * b
        shapes = {"focals": (b, 2), "fit_scale": (b,), "focal_precision": (b, 2, 2)}
        self.cameras = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
        self.lens, self.lens_suggested = np.full((b, 2), np.nan), np.full(b, np.nan)
        self.assumes_cameras = calibrated is not None
        self.asked_for_cameras = family.model == "fundamental" and c.asks_for_cameras
        self.graphed = torch.is_grad_enabled() and c.requires_grad
        self.solved: dict[int, Solved] = {}

    def rows(self, part: Sequence[int]) -> Iterator[Row]:
        """Those of a part that can be tried; the others have their reason."""
        for i in part:
            matches = self.batch.pair(i)
            needed = self.calibrated if self.batch.calibrated(i) else self.minimal
            normalized = self.batch.normalized(matches, i, self.seed, needed, self.family.residual)
            if isinstance(normalized, str):
                self.reasons[i] = normalized
            else:
                yield Row(i, matches, *normalized, needed)

    def put(self, row: Row, solution: Solution) -> None:
        """The solution of a pair as its estimate, or the reason why there is none."""
        i, matches, pair, slot, needed = row if solution.pair is None else row._replace(pair=solution.pair)
        self.samples[i] = solution.samples
        if solution.fit is None or solution.inliers is None:
            self.reasons[i] = solution.reason
        elif degenerate := degenerate_support(pair, solution.inliers, needed, relative_rounding(self.c)):
            self.reasons[i] = degenerate
        elif not self.family.to_pixels(solution.fit.F, pair, self.F[i]):
            self.F[i], self.reasons[i] = 0, NOT_FINITE
        else:
            self.ok[i] = True
            self.inliers[i, slot] = solution.inliers
            fundamental = self.family.model == "fundamental"
            if solution.lens is not None:
                matches = _straight(matches, pair, slot, solution.lens)
            given = matches.x0, matches.x1, matches.mask, matches.sizes[:2], matches.sizes[2:]
            self.significance[i] = of_one_pair(self.F[i], *given) if fundamental else np.nan
            if solution.lens is not None:
                determined = solution.deviation is None or solution.deviation <= MAX_LENS_DEVIATION
                self.lens[i] = np.where(determined, solution.lens, np.nan)
            self.lens_suggested[i] = solution.lens_suggested
            if self.asked_for_cameras and pair.sizes_known:
                fit = solution.fit
                focals = focals_near(fit.F, pair) if fit.cameras is None else focals_px(fit.cameras, pair)
                known = focals, scale_of(fit, pair), focal_precision(focals, pair)
                for rows, value in zip(self.cameras.values(), known, strict=True):
                    rows[i] = value
            if self.graphed:
                self.solved[i] = Solved(pair, slot, solution.fit)

    def estimates(self, attach: Attach) -> Estimate:
        """What has become of the pairs; attach: of the gradients of their fits."""
        arrays = {"matrix": self.F, "inliers": self.inliers, "ok": self.ok, "samples": self.samples}
        arrays["significance"] = self.significance
        if self.asked_for_cameras:
            arrays |= self.cameras
        if self.batch.lens is not None:
            arrays["lens"] = self.lens
        elif self.assumes_cameras:
            arrays["lens_suggested"] = self.lens_suggested
        fields = {name: torch.from_numpy(value).to(self.c.mask.device) for name, value in arrays.items()}
        estimates = Estimate.unchecked(reason=tuple(self.reasons), model=self.family.model, **fields)
        return with_gradients(estimates, self.c, self.solved, attach) if self.graphed else estimates


def _straight(matches: PixelMatches, pair: Pair, slot: Array, lens: Array) -> PixelMatches:
    """The matches of a pair, which stand in these slots, as pinholes would have them."""
    x0, x1 = matches.x0.copy(), matches.x1.copy()
    points = undistorted(pair, lens).points.T * pair.pixels_per_unit + pair.centre
    x0[slot], x1[slot] = points[:, :2], points[:, 2:]
    return matches._replace(x0=x0, x1=x1)


def relative_rounding(c: Correspondences) -> float:
    """The rounding error of a coordinate of 1; 0 of integers."""
    return torch.finfo(c.x0.dtype).eps if c.x0.dtype.is_floating_point else 0.0


def shared_out(c: Correspondences) -> list[torch.Tensor]:
    """The rows of a batch in parts of about equal work, pairs of many matches first."""
    work, order = c.count().clamp_min(MIN_WORK).sort(descending=True)
    before = work.cumsum(0) - work
    part = before * (PARTS_OF_A_THREAD * available()) // max(1, int(work.sum()))
    return list(torch.split(order, torch.unique_consecutive(part, return_counts=True)[1].tolist()))


class Batch(NamedTuple):
    """The tensors of a batch on the host as arrays, one row a pair; sizes: (b, 4), h, w, h, w, empty where unknown.
    focal: (b, 2, 2); shared: (b,), whether both focal lengths are one; lens: (b, 2, 2), and one_lens (b,) likewise."""

    x0: Array
    x1: Array
    mask: Array
    prior: Array | None
    noise: Array | None
    ambiguity: Array | None
    sizes: Array
    keys: list[int]
    focal: Array | None
    shared: Array
    lens: Array | None
    one_lens: Array
    stretch: Array | None

    @staticmethod
    def of(c: Correspondences) -> "Batch":
        """Views where the tensors are of float32 or float64."""
        prior, noise, ambiguity = [None if t is None else _array(t) for t in (c.prior, c.noise, c.ambiguity)]
        keys: list[int] = c.keys.tolist()
        sizes = np.empty((len(keys), 0 if c.size0 is None else 4))
        if c.size0 is not None and c.size1 is not None:
            sizes[:, :2], sizes[:, 2:] = _array(c.size0), _array(c.size1)
        shared = np.zeros(len(keys), np.bool_) if c.shared_focal is None else c.shared_focal.numpy()
        focal = None if c.focal is None else np.asarray(_array(c.focal), np.float64)
        if focal is None and shared.any():
            focal = np.full((len(keys), 2, 2), np.inf)
        lens = None if c.lens is None else np.asarray(_array(c.lens), np.float64)
        one_lens = np.zeros(len(keys), np.bool_) if c.shared_lens is None else c.shared_lens.numpy()
        matches = _array(c.x0), _array(c.x1), c.mask.numpy()
        stretch = None if c.stretch is None else np.asarray(_array(c.stretch), np.float64)
        return Batch(*matches, prior, noise, ambiguity, sizes, keys, focal, shared, lens, one_lens, stretch)

    def pair(self, i: int) -> PixelMatches:
        """One row, in float64."""
        return PixelMatches(
            _row(self.x0, i), _row(self.x1, i), np.ascontiguousarray(self.mask[i]), _row(self.prior, i),
            _row(self.noise, i), _row(self.ambiguity, i), self.sizes[i],
        )  # fmt: skip

    def calibrated(self, i: int) -> bool:
        """Whether image sizes and both focal lengths of a row are exactly known."""
        calibration = None if self.focal is None else calibration_of(self.focal[i], bool(self.shared[i]))
        return calibration is not None and calibration.exact and self.sizes.shape[1] > 0

    def normalized(
        self, matches: PixelMatches, i: int, seed: int, minimal: int, residual: Residual = SAMPSON
    ) -> tuple[Pair, Array] | str:
        """The pair of a row, and where its matches (n,) stood; or why it cannot be estimated."""
        n, frame = len(matches.mask), np.empty(6)
        slots, flat = np.empty(n, np.int64), np.empty(9 * n)
        known = self.prior is not None, self.noise is not None, self.ambiguity is not None
        stretch = self.stretch
        if stretch is not None and self.noise is not None:
            matches = matches._replace(noise=matches.noise / mean_stretch(stretch[i]))
        count = normalize_pair(matches, slots, flat, frame)
        slot, table, (unit, right) = slots[:count], flat[: 9 * count].reshape(9, count), frame[4:].tolist()
        if count < minimal:
            return f"{count} matches; at least {minimal} are needed"
        focal = None if self.focal is None else self.focal[i]
        if not right or (focal is not None and not FOCAL.holds(focal).all()):
            return _wrong_values(matches, slot)
        if not unit:
            return "all matches coincide"
        calibration = None if focal is None else calibration_of(focal, bool(self.shared[i]))
        lens = None
        if self.lens is not None:
            if not matches.sizes.size:
                return NO_SIZES
            (m0, s0), (m1, s1) = self.lens[i].tolist()
            lens = Lens((m0, m1), (s0, s1), bool(self.one_lens[i]))
        pair = Pair(
            table, known, bucket(count), unit, self.keys[i], seed, frame[:4], matches.sizes, residual, calibration,
            lens=lens,
        )  # fmt: skip
        return pair if stretch is None else stretched(pair, stretch[i, slot]), slot


def _wrong_values(matches: PixelMatches, slot: Array) -> str:
    """Why a pair whose matches have such values cannot be estimated."""
    for name, value, rule in (("prior", matches.prior, PROBABILITY), ("noise", matches.noise, DEVIATION)):
        if len(value) and (wrong := int(np.count_nonzero(~rule.holds(value[slot])))):
            return f"{name} of {wrong} match{'' if wrong == 1 else 'es'} is wrong: {rule.text}"
    for name, size in (("size0", matches.sizes[:2]), ("size1", matches.sizes[2:])):
        if not SIZE.holds(size).all():
            return f"{name} is wrong: {SIZE.text}"
    return f"focal is wrong: {FOCAL.text}"


def _row(values: Array | None, i: int) -> Array:
    return np.empty(0) if values is None else np.ascontiguousarray(values[i], np.float64)


def _array(tensor: torch.Tensor) -> Array:
    known = tensor.dtype in (torch.float32, torch.float64) or not tensor.is_floating_point()
    return as_array(tensor if known else tensor.to(torch.float64))

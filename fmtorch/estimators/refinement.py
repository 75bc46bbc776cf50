"""The models of a pool made better, on their inliers and by Levenberg-Marquardt, and one of them selected."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from fmtorch.core.options import Within
from fmtorch.estimators.models.fundamental import Matrices
from fmtorch.estimators.models.posterior import Cameras
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.preselection import Count, NonNegative, first_shuffled
from fmtorch.estimators.scores import Score, scored
from fmtorch.estimators.search import Pool
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON, Residual
from fmtorch.geometry.levenberg_marquardt import Schedule
from fmtorch.jit.kernel import Array, F4x2, I8x1, Kernel, kernel
from fmtorch.jit.random import Stream

Pixels = Annotated[float, Within(0, exclusive=True)]


@dataclasses.dataclass(frozen=True)
class Refine:
    """Levenberg-Marquardt of the robust Sampson error, from each model of the pool.

    loss: a name of `geometry.LOSSES`. scale: its scale, Sampson distance, px. iterations: steps. matches: at most so
    many are looked at, drawn by the pair's key from those within RADIUS scales of a model of the pool; None: all.
    """

    loss: Literal["huber", "cauchy", "geman_mcclure", "truncated", "magsac"]
    scale: Pixels = 1.0
    iterations: NonNegative = 5
    matches: Count | None = None

    RADIUS = 4.0  # scales: a match farther from all models of the pool is not looked at again


@dataclasses.dataclass(frozen=True)
class Select:
    """Which refined model is the estimate: that of the largest score.

    score: a name of `PARTS`, or a score. scale: of it, Sampson distance, px. own_noise: the choice is made again
    with so many standard deviations of the noise of the matches near the first for a scale; None: it is made once.
    """

    score: Any = "saturated"
    scale: Pixels = 1.0
    own_noise: Pixels | None = None


LocalOptimization = Callable[[Array, Pair], Array]
"""Improves the models (k, 9) of a small pool, float64; none comes back with a lower score than it had."""


class Candidates(NamedTuple):
    """The models of a pool, refined: F (m, 9) float64; whether there are any; the matches they were refined on."""

    F: Array
    valid: bool
    near: Pair


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Local optimisation of each model on its inliers, then Levenberg-Marquardt on the matches near the pool.
    options: of the latter; None: none. local_optimization: None: none."""

    options: Refine | None
    local_optimization: LocalOptimization | None = None

    def near(self, pool: Pool, pair: Pair) -> Pair:
        """The pair with the matches on which the pool's models are refined: at most so many of those within reach.
        Which of them, the pair's key decides."""
        if self.options is None or self.options.matches is None:
            return pair
        limit = np.float32(squared(self.options.RADIUS * self.options.scale / pair.pixels_per_unit))
        index = np.empty(min(self.options.matches, pair.count), np.int64)
        seed = pair.mixed_seed(Stream.REFINEMENT)
        return pair.take(
            index[: near_of(pair.residual)(pool.F[: pool.filled], pair.points32, limit, seed, pair.key, index)]
        )

    def __call__(self, pool: Pool, pair: Pair, family: Matrices) -> Candidates:
        """The pool with refined models."""
        F, near = pool.models, self.near(pool, pair)
        if self.local_optimization is not None:
            F = self.local_optimization(F, pair)
        if (options := self.options) is not None:
            F = family.refine(F, near, options.loss, options.scale, Schedule(options.iterations))
        return Candidates(F, pool.filled > 0, near)


@functools.cache
def near_of(residual: Residual) -> Kernel[..., int]:
    """The kernel that looks for matches near models, for a residual."""
    within = residual.within

    @kernel(name=f"near_{residual.name}")
    def near(F: F4x2, points: F4x2, limit: np.float32, mixed_seed: int, key: int, out: I8x1) -> int:
        """Points (4, n) within a squared residual of one of the models (k, 9), the first in a random order -> out.
        How many they are. Nothing is near a model of zeros."""
        x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
        wanted = np.zeros(points.shape[1], np.bool_)
        for k in range(len(F)):
            f = (F[k, 0], F[k, 1], F[k, 2], F[k, 3], F[k, 4], F[k, 5], F[k, 6], F[k, 7], F[k, 8])
            zero = True
            for q in range(9):
                zero = zero and F[k, q] == 0
            for i in range(0 if zero else len(wanted)):
                wanted[i] |= within(f, x0[i], y0[i], x1[i], y1[i], limit)
        index, count = np.empty(len(wanted), np.int64), 0
        for i in range(len(wanted)):
            index[count] = i
            count += wanted[i]
        return first_shuffled(index[:count], mixed_seed, key, out)

    return near


near = near_of(SAMPSON)
near_homography = near_of(HOMOGRAPHY)


class Selection(NamedTuple):
    """The selected model (9,), float64, whether there is one, and its cameras (1, ...), None where none are assumed."""

    F: Array
    valid: bool
    cameras: Cameras | None = None


class BestScore:
    """The model of the largest score.

    No scale suits all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar lines, those of
    learned features within one. So with `at_noise`, the score at the noise of a pair by the matches near a model (9,),
    the choice is made a second time, at the noise of the first.
    """

    def __init__(self, score: Score, at_noise: Callable[[Array, Pair], Score] | None = None) -> None:
        self.score, self.at_noise = score, at_noise

    def __call__(self, candidates: Candidates, pair: Pair) -> Selection:
        """The selection."""
        first = self.first(candidates, pair)
        return first if self.at_noise is None else _largest(self.of_pair(first.F, pair), candidates, pair)

    def first(self, candidates: Candidates, pair: Pair) -> Selection:
        """The model of the largest score at its own scale."""
        return _largest(self.score, candidates, pair)

    def of_pair(self, F: Array, pair: Pair) -> Score:
        """The score of the second choice, near a model (9,) of the first."""
        return self.score if self.at_noise is None else self.at_noise(F, pair)


def _largest(score: Score, candidates: Candidates, pair: Pair) -> Selection:
    return Selection(candidates.F[int(np.argmax(scores_of(score, candidates.F, pair)))], candidates.valid)


def scores_of(score: Score, F: Array, pair: Pair) -> Array:
    """Scores (k,) of models (k, 9), float64, on all matches."""
    return scored(score, F.astype(np.float32), np.arange(len(F)), pair)

"""`focal.selection` on the arrays of one pair: the choice among candidates refined with the prior."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fmtorch.estimators.focal import selection
from fmtorch.estimators.focal.selection import MIN_GAIN_SHARE, RIVAL_GAIN_SHARE, SAME_CAMERAS, SAME_MODEL
from fmtorch.estimators.focal.selection_kernels import posteriors, rivals
from fmtorch.estimators.one_pair.focal.cameras import TwoCameras
from fmtorch.estimators.one_pair.focal.posterior import Refined, refine_near_with_prior, refine_with_prior
from fmtorch.estimators.one_pair.models import Pool
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.refinement import AsFound, PoolRefinement
from fmtorch.estimators.one_pair.scores import Score
from fmtorch.estimators.one_pair.selection import Selection, scored


class Candidates:
    """As `selection.Candidates`: models (k, 9), posteriors (k,), cameras.

    best: the candidate of the greatest posterior, the first of several. found: whether there is one.
    """

    def __init__(self, F: Array, posterior: Array, cameras: TwoCameras) -> None:
        self.F, self.posterior, self.cameras = F, posterior, cameras
        self.best = int(posterior.argmax())
        self.found = math.isfinite(posterior[self.best])

    def only(self, rows: Sequence[int]) -> Candidates:
        """As `selection.Candidates.only`: itself."""
        return self

    def joined(self, other: Candidates) -> Candidates:
        """The candidates of both."""
        F, posterior = np.concatenate([self.F, other.F]), np.concatenate([self.posterior, other.posterior])
        return Candidates(F, posterior, self.cameras.joined(other.cameras))

    def best_alone(self) -> Candidates:
        """As `selection.Candidates.best_alone`."""
        one = slice(self.best, self.best + 1)
        cameras = TwoCameras(self.cameras.axes[one], self.cameras.focal[one])
        return Candidates(self.F[one], self.posterior[one], cameras)

    def replaced(self, rows: Sequence[int], other: Candidates) -> Candidates:
        """As `selection.Candidates.replaced`: the other."""
        return other

    def selection(self, draws: int) -> Selection:
        """As `selection.Candidates.selection`."""
        return Selection(self.F[self.best], self.found, draws, self.cameras.of(self.best))

    def same_best(self, other: Candidates) -> list[bool]:
        """As `selection.Candidates.same_best`."""
        both = np.stack([self.F[self.best], other.F[other.best]])
        return [self.found and other.found and not rivals(both, np.ones(2), 0, 1.0, SAME_CAMERAS)]

    def unambiguous(self) -> list[bool]:
        """As `selection.Candidates.unambiguous`."""
        return [self.found and not rivals(self.F, self.posterior, self.best, RIVAL_GAIN_SHARE, SAME_CAMERAS)]


class FocalSelection:
    """As `selection.FocalSelection`."""

    def __init__(self, part: selection.FocalSelection, gain: Score) -> None:
        self.gain, self.iterations, self.candidates = gain, part.iterations, part.candidates

    def of_pool(self, pool: Pool, pair: OnePair, refinement: PoolRefinement | AsFound) -> Candidates:
        """As `selection.FocalSelection.of_pool`."""
        near = refinement.which_near(pair)
        if near is None or not pool.filled:
            return self.refined(pool.models, pool.valid, pair, refinement.near(pool, pair))
        made = refine_near_with_prior(pool.F[: pool.filled], pair, near, self.iterations)
        return self._candidates(made, pool.valid, pair)

    def refined(self, F: Array, valid: Array, pair: OnePair, near: OnePair) -> Candidates:
        """As `selection.FocalSelection.refined`."""
        return self._candidates(refine_with_prior(F, near, self.iterations), valid, pair)

    def _candidates(self, made: Refined, valid: Array, pair: OnePair) -> Candidates:
        posterior = np.empty(len(made.models))
        posteriors(scored(self.gain, made.models, pair), made.share, made.cost, valid, posterior)
        return Candidates(made.models, posterior, made.cameras)

    def select(self, pool: Pool, pair: OnePair, others: Candidates | None) -> Selection:
        """As `selection.FocalSelection.select`."""
        assert pool.near is not None
        models, found = pool.models, pool.filled > 0
        gain = np.where(pool.valid, scored(self.gain, models, pair), -np.inf)
        order = np.argsort(-gain, kind="stable")
        models, gain = models[order], gain[order]
        free = Selection(models[0], found, pool.draws)
        if others is None and not rivals(models, gain, 0, RIVAL_GAIN_SHARE, SAME_MODEL):
            return free
        tried = slice(self.candidates)
        candidates = self.refined(models[tried], np.isfinite(gain[tried]), pair, pool.near)
        if others is not None:
            candidates = candidates.joined(others)
        best = candidates.best
        if not candidates.posterior[best] >= MIN_GAIN_SHARE * gain[0]:
            return free
        return free._replace(F=candidates.F[best], cameras=candidates.cameras.of(best))

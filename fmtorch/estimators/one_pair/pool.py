"""`pool` on the arrays of one pair: from a round's hypotheses to those that may enter the pool."""

from __future__ import annotations

import numpy as np

from fmtorch.core.random import Stream, mixed_seed
from fmtorch.estimators import pool_kernels as compiled
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import Score
from fmtorch.estimators.options import Preselect


class Verifier:
    """As `pool.Verifier`."""

    def __init__(self, score: Score, preselect: Preselect | None, prior_weighted: bool) -> None:
        self.score, self.preselect, self.prior_weighted = score, preselect, prior_weighted

    def __call__(self, models: Models, pair: OnePair) -> Models:
        """As `pool.Verifier`."""
        few = self.first_look(pair) if len(models.F) else None
        survivors = len(models.F) if few is None or self.preselect is None else self.preselect.survivors
        which, score = self.score.verify(models.F, survivors, pair if few is None else few, pair)
        return Models(models.F, models.draw, models.samples, models.start, which, score)

    def first_look(self, pair: OnePair) -> OnePair | None:
        """The pair with the matches of the first look; None where there is none."""
        if self.preselect is None or pair.slots < 2 * self.preselect.matches:
            return None
        matches = self.preselect.matches
        few = likely if self.prior_weighted and pair.prior is not None else shuffled_first
        found: OnePair = pair.once(("first look", few, matches), lambda pair: few(pair, matches))
        return found


def shuffled_first(pair: OnePair, count: int) -> OnePair:
    """The pair with so many of its matches in the order of `pool.in_random_order`."""
    return pair.take(shuffled(pair, Stream.PRESELECTION, count))


def likely(pair: OnePair, count: int) -> OnePair:
    """The pair with so many of its matches in the order of `pool.by_priority`; those of any prior count as one."""
    index = np.empty(min(count, pair.count), np.int64)
    compiled.drawn_by_prior(pair.support, mixed_seed(pair.seed, Stream.PRESELECTION), pair.key, index)
    few = pair.take(index)
    np.greater(few.support, 0, out=few.support)
    return few


def shuffled(pair: OnePair, stream: Stream, most: int) -> Array:
    """The first so many matches in an order that the pair's key decides: as `pool.shuffled`."""
    index = np.empty(min(most, pair.count), np.int64)
    return index[: compiled.shuffled(pair.count, mixed_seed(pair.seed, stream), pair.key, index)]

"""`saturated_gains` on the arrays of one pair, in float32."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators import saturated_gains
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import GemanMcClure, OfMatches, matches, room
from fmtorch.estimators.scores_kernels import saturated_cells, score_saturated
from fmtorch.estimators.verify_kernels import verify_by_saturated_gains

_OfMatches = tuple[Array, Array, Array, Array, int]  # points, support, scale, cells, fractional bits


class SaturatedGains:
    """As `saturated_gains.SaturatedGains`."""

    def __init__(self, part: saturated_gains.SaturatedGains) -> None:
        self.part = part
        self.first_look = GemanMcClure(part.first_look)

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `scores.Score`."""
        out = np.empty(len(which))
        score_saturated(F, which, *self.of(pair), out)
        return out

    def verify(self, F: Array, survivors: int, few: OnePair, pair: OnePair) -> tuple[Array, Array]:
        """As `scores.Score.verify`, on few matches by the plain sum of gains."""
        which, score = room(len(F), survivors)
        verify_by_saturated_gains(F, *self.first_of(few), *self.of(pair), which, score)
        return which, score

    def first_of(self, few: OnePair) -> tuple[Array, Array, Array, int, int, Array]:
        """What a first look takes of its matches, and the gain that it sums."""
        look = self.first_look
        first: OfMatches = few.once(look, look.matches)
        return (*first, look.GAIN, look.table)

    def of(self, pair: OnePair) -> _OfMatches:
        """What the kernels take of the matches, made once."""
        matches: _OfMatches = pair.once(self, self._matches)
        return matches

    def _matches(self, pair: OnePair) -> _OfMatches:
        """What the kernel takes of the matches."""
        weighted = self.part.prior_weighted
        points, support, scale, bits = matches(pair, self.part.threshold, weighted)
        cells = pair.once(("cells", weighted), lambda pair: _cells(points, support))
        return points, support, scale, cells, bits


def _cells(points: Array, support: Array) -> Array:
    cells = np.empty((2, len(support)), np.int32)
    saturated_cells(points, support, cells)
    return cells

"""`saturated_gains` on the arrays of one pair, in float32."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators import saturated_gains
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import GemanMcClure, Scored
from fmtorch.estimators.scores_kernels import saturated_cells, score_saturated


class SaturatedGains:
    """As `saturated_gains.SaturatedGains`."""

    def __init__(self, part: saturated_gains.SaturatedGains) -> None:
        self.part = part
        self.first_look = GemanMcClure(part.first_look)

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `scores.Score`."""
        weighted, out = self.part.prior_weighted, np.empty(len(which))
        of = Scored.of(pair, self.part.threshold, weighted)
        cells = pair.once(("cells", weighted), lambda pair: _cells(of))
        score_saturated(F, which, of.points, of.support, of.scale, cells, of.bits, out)
        return out


def _cells(of: Scored) -> Array:
    cells = np.empty((2, len(of.support)), np.int32)
    saturated_cells(of.points, of.support, cells)
    return cells

"""`saturated_gains` on the arrays of one pair, in float32."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators import saturated_gains
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import GemanMcClure, matches
from fmtorch.estimators.scores_kernels import saturated_cells, score_saturated


class SaturatedGains:
    """As `saturated_gains.SaturatedGains`."""

    def __init__(self, part: saturated_gains.SaturatedGains) -> None:
        self.part = part
        self.first_look = GemanMcClure(part.first_look)

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `scores.Score`."""
        out = np.empty(len(which))
        points, support, scale, cells, bits = pair.once(self, self._matches)
        score_saturated(F, which, points, support, scale, cells, bits, out)
        return out

    def _matches(self, pair: OnePair) -> tuple[Array, Array, Array, Array, int]:
        """What the kernel takes of the matches."""
        weighted = self.part.prior_weighted
        points, support, scale, bits = matches(pair, self.part.threshold, weighted)
        cells = pair.once(("cells", weighted), lambda pair: _cells(points, support))
        return points, support, scale, cells, bits


def _cells(points: Array, support: Array) -> Array:
    cells = np.empty((2, len(support)), np.int32)
    saturated_cells(points, support, cells)
    return cells

"""`saturated_gains` on the arrays of one pair, in float32."""

from __future__ import annotations

import numpy as np
import torch

from fmtorch.estimators import saturated_gains
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import GemanMcClure, matches
from fmtorch.estimators.scores_kernels import saturated_cells, score_saturated
from fmtorch.geometry.arithmetic import fractional_bits


class SaturatedGains:
    """As `saturated_gains.SaturatedGains`."""

    def __init__(self, part: saturated_gains.SaturatedGains) -> None:
        self.part = part
        self.first_look = GemanMcClure(part.first_look)

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `scores.Score`."""
        support, scale = matches(pair, self.part.threshold, self.part.prior_weighted)
        cells = pair.once(("cells", self.part.prior_weighted), lambda: _cells(pair, support))
        out, bits = np.empty(len(which)), fractional_bits(pair.count, torch.float32)
        score_saturated(F, which, pair.points32, support, scale, cells, bits, out)
        return out


def _cells(pair: OnePair, support: Array) -> Array:
    cells = np.empty((2, pair.count), np.int32)
    saturated_cells(pair.points32, support, cells)
    return cells

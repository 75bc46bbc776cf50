"""`focal.hypotheses` on the arrays of one pair: five matches and drawn focal lengths, the same draws."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.estimators.focal import hypotheses, prior
from fmtorch.estimators.focal.hypotheses_kernels import draw_depths
from fmtorch.estimators.one_pair.focal.cameras import CentredPair
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.sampling import Sampler
from fmtorch.geometry.five_point_kernels import five_point
from fmtorch.random import Stream, mixed_seed

SOLUTIONS = 10  # of five matches, at most
NUMBERS = np.array(
    [math.log(prior.USUAL_FOCAL), prior.FOCAL_DEVIATION, prior.RATIO_DEVIATION / 2, prior.SAME_CAMERA_SHARE]
)  # as the kernel takes them
QUANTILES = prior.NORMAL.numpy()


class FocalSamples:
    """As `hypotheses.FocalSamples`."""

    size = hypotheses.FocalSamples.size

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler

    def __call__(self, pair: OnePair, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        sample, centred = self.sampler.draw(pair, start, count, self.size), CentredPair.of(pair)
        depth = depths(pair, centred, start, count)
        F, draw = np.empty((SOLUTIONS * count, 9), np.float32), np.empty(SOLUTIONS * count, np.int64)
        m = five_point(centred.points, sample, depth, centred.offset, F, draw)
        return Models(F[:m], draw[:m], sample, start)


def depths(pair: OnePair, centred: CentredPair, start: int, count: int) -> Array:
    """Focal lengths (2, count) of draws in the unit of the points: those of `prior.draw_focal_lengths`."""
    out, seed = np.empty((2, count)), mixed_seed(pair.seed, Stream.FOCAL)
    draw_depths(QUANTILES, NUMBERS, centred.same_size, centred.longest, seed, pair.key, start, out)
    return out

"""`focal.hypotheses` on the arrays of one pair: five matches and drawn focal lengths, the same draws."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.estimators.focal import hypotheses, prior
from fmtorch.estimators.focal.hypotheses_kernels import samples_of_five
from fmtorch.estimators.one_pair.focal.cameras import CentredPair
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.sampling import Sampler, seed_of
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
        urn, centred = self.sampler.urn(pair, start, count, self.size), CentredPair.of(pair)
        sample = np.empty((self.size, count), np.int64)
        F, draw = np.empty((SOLUTIONS * count, 9), np.float32), np.empty(SOLUTIONS * count, np.int64)
        m = samples_of_five(
            *urn, QUANTILES, NUMBERS, centred.same_size, centred.longest, seed_of(pair),
            mixed_seed(pair.seed, Stream.FOCAL), pair.key, start, centred.points, centred.offset, sample, F, draw,
        )  # fmt: skip
        return Models(F[:m], draw[:m], sample, start)

"""`focal.hypotheses` on the arrays of one pair: five matches and drawn focal lengths, the same draws."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators.focal import hypotheses, prior
from fmtorch.estimators.focal.hypotheses_kernels import SOLUTIONS, samples_of_five
from fmtorch.estimators.focal.prior_kernels import LOG_USUAL
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, images_of
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.sampling import Sampler, Urn, seed_of
from fmtorch.random import Stream, mixed_seed

NUMBERS = np.array(
    [LOG_USUAL, prior.FOCAL_DEVIATION, prior.RATIO_DEVIATION / 2, prior.SAME_CAMERA_SHARE]
)  # as the kernel takes them
QUANTILES = prior.NORMAL.numpy()


class FocalSamples:
    """As `hypotheses.FocalSamples`."""

    size = hypotheses.FocalSamples.size

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler

    def __call__(self, pair: OnePair, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        urn, numbers, centred = self.urn(pair, start, count), self.numbers(pair), CentredPair.of(pair)
        sample = np.empty((self.size, count), np.int64)
        F, draw = np.empty((SOLUTIONS * count, 9), np.float32), np.empty(SOLUTIONS * count, np.int64)
        told = *urn, *numbers, start, centred.points, centred.offset
        m = samples_of_five(*told, sample, F, draw)
        return Models(F[:m], draw[:m], sample, start)

    def urn(self, pair: OnePair, start: int, count: int) -> Urn:
        """What the draws start .. start + count - 1 are made from."""
        return self.sampler.urn(pair, start, count, self.size)

    @staticmethod
    def numbers(pair: OnePair) -> tuple[Array, Array, bool, Array, int, int, int]:
        """What kernels take of the prior and of a pair to draw samples and focal lengths."""
        _, longest, same_size = images_of(pair)
        return QUANTILES, NUMBERS, same_size, longest, seed_of(pair), mixed_seed(pair.seed, Stream.FOCAL), pair.key

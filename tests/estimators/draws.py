"""Samples as the samplers of one pair draw them, without solving them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.sampling import Sampler, seed_of
from fmtorch.estimators.sampling_kernels import draw_from


def drawn(sampler: Sampler, pair: OnePair, start: int, count: int, size: int) -> NDArray[Any]:
    """The matches (size, count) of the draws start .. start + count - 1."""
    out = np.empty((size, count), np.int64)
    draw_from(*sampler.urn(pair, start, count, size), seed_of(pair), pair.key, start, out)
    return out

"""`match_noise` for one pair, compiled: the same bits."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import B1x1, F4x1, F4x3
from fmtorch.compiling.kernel import inner, kernel

ONE32 = np.float32(1)


class FramedMatches(NamedTuple):
    """The matches of one pair: frames lafs0, lafs1 (n, 2, 3), pixels, and which are real, mask (n,).

    quality, prior: (n,), empty where unknown.
    """

    lafs0: F4x3
    lafs1: F4x3
    quality: F4x1
    prior: F4x1
    mask: B1x1


@kernel
def match_noise(matches: FramedMatches, numbers: F4x1, out: F4x1) -> None:
    """`MatchNoise` of n matches -> out (n,); one where masked or where it cannot be told.

    numbers: usual, radius in pixels, slope, least area in square pixels, least prior.
    """
    lafs0, lafs1, quality, prior, mask = matches
    usual, radius, slope, min_area, min_prior = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(len(mask)):
        size = max(_scale(lafs0, i, min_area), _scale(lafs1, i, min_area))
        noise = (ONE32 + size / radius) / usual
        valid = mask[i] and _finite(lafs0, i) and _finite(lafs1, i)
        if len(quality):
            valid = valid and math.isfinite(quality[i])
            factor = ONE32 + slope * quality[i]
            noise *= factor * factor
        if len(prior):
            valid = valid and math.isfinite(prior[i])
            noise /= math.sqrt(math.sqrt(max(prior[i], min_prior)))
        out[i] = noise if valid else ONE32


@inner
def _scale(lafs: F4x3, i: int, min_area: np.float32) -> float:
    """The square root of the area that frame i maps the unit square to."""
    return math.sqrt(max(abs(lafs[i, 0, 0] * lafs[i, 1, 1] - lafs[i, 0, 1] * lafs[i, 1, 0]), min_area))


@inner
def _finite(lafs: F4x3, i: int) -> bool:
    """Whether all numbers of frame i are finite."""
    finite = True
    for row in range(2):
        for column in range(3):
            finite = finite and math.isfinite(lafs[i, row, column])
    return finite

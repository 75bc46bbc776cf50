"""`match_noise` for one pair, compiled: the same bits."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel

Array = NDArray[Any]


@kernel("f4[:, :, ::1], f4[:, :, ::1], f4[::1], f4[::1], b1[::1], f4[::1], f4[::1]")
def match_noise(
    lafs0: Array, lafs1: Array, quality: Array, prior: Array, mask: Array, numbers: Array, out: Array
) -> None:  # fmt: skip
    """`MatchNoise` of frames (n, 2, 3) -> out (n,); one where masked or where it cannot be told.

    quality, prior: (n,), empty where unknown. numbers: usual, radius, slope, least area, least prior.
    """
    one = numbers.dtype.type(1)
    for i in range(len(mask)):
        size = max(_scale(lafs0, i, numbers[3]), _scale(lafs1, i, numbers[3]))
        noise = (one + size / numbers[1]) / numbers[0]
        valid = mask[i] and _finite(lafs0, i) and _finite(lafs1, i)
        if len(quality):
            valid = valid and math.isfinite(quality[i])
            factor = one + numbers[2] * quality[i]
            noise *= factor * factor
        if len(prior):
            valid = valid and math.isfinite(prior[i])
            noise /= math.sqrt(math.sqrt(max(prior[i], numbers[4])))
        out[i] = noise if valid else one


@inner
def _scale(lafs: Array, i: int, least: float) -> float:
    """The square root of the area that frame i maps the unit square to."""
    return math.sqrt(max(abs(lafs[i, 0, 0] * lafs[i, 1, 1] - lafs[i, 0, 1] * lafs[i, 1, 0]), least))


@inner
def _finite(lafs: Array, i: int) -> bool:
    """Whether all numbers of frame i are finite."""
    finite = True
    for row in range(2):
        for column in range(3):
            finite = finite and math.isfinite(lafs[i, row, column])
    return finite

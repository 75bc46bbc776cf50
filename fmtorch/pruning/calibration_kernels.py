"""`calibration` for one pair, compiled: the same bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel

Array = NDArray[Any]


@kernel("f4[::1], f4[::1], b1[::1], f4[::1], f4[::1]")
def calibrated(evidence: Array, quality: Array, mask: Array, numbers: Array, out: Array) -> None:
    """P(inlier) of `Calibration` from evidence and ratio (n,) -> out (n,); zero where masked.

    quality: empty where unknown. numbers: constant, weights of evidence and ratio, largest log-odds, and 2^-10.
    """
    one = evidence.dtype.type(1)
    for i in range(len(mask)):
        z = numbers[0] + numbers[1] * evidence[i]
        if len(quality):
            z += numbers[2] * (one if np.isnan(quality[i]) else quality[i])
        o = 1.0 + np.float64(min(max(z, -numbers[3]), numbers[3])) * numbers[4]
        for _ in range(10):
            o *= o
        out[i] = o / (o + 1.0) if mask[i] else 0.0

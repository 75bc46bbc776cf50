"""`calibration` for one pair, compiled: the same bits."""

from __future__ import annotations

import numpy as np

from fmtorch.compiling.arrays import B1x1, F4x1
from fmtorch.compiling.kernel import kernel


@kernel
def calibrated(evidence: F4x1, quality: F4x1, mask: B1x1, numbers: F4x1, out: F4x1) -> None:
    """P(inlier) of `Calibration` from evidence and ratio (n,) -> out (n,); zero where masked.

    quality: empty where unknown. numbers: constant, weights of evidence and ratio, largest log-odds, and 2^-10.
    """
    for i in range(len(mask)):
        z = numbers[0] + numbers[1] * evidence[i]
        if len(quality):
            z += numbers[2] * (np.float32(1) if np.isnan(quality[i]) else quality[i])
        o = 1.0 + np.float64(min(max(z, -numbers[3]), numbers[3])) * numbers[4]
        for _ in range(10):
            o *= o
        out[i] = o / (o + 1.0) if mask[i] else 0.0

"""The candidates of one pair, compiled: what they are worth, and whether they are one and the same model."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel

Array = NDArray[Any]


@kernel("f8[::1], f8[::1], f8[::1], b1[::1], f8[::1]", brief=True)
def posteriors(gain: Array, share: Array, cost: Array, valid: Array, out: Array) -> None:
    """Gain times share in front minus cost -> out (k,), minus infinity of none: `selection.FocalSelection.refined`."""
    for k in range(len(out)):
        posterior = gain[k] * share[k] - cost[k]
        out[k] = posterior if valid[k] and not math.isnan(posterior) else -math.inf


@kernel("f8[:, ::1], f8[::1], i8, f8, f8", brief=True)
def rivals(F: Array, gain: Array, best: int, share: float, same: float) -> bool:
    """Whether a model (k, 9) that has a share of the gain (k,) of the best is another one than it."""
    for k in range(len(F)):
        cosine = 0.0
        for i in range(9):
            cosine += F[k, i] * F[best, i]
        if gain[k] >= share * gain[best] and not 1 - abs(cosine) <= same:
            return True
    return False

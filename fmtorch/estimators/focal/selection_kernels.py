"""Whether candidates are one and the same model, of one pair, compiled: as `selection`."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fmtorch.kernels import kernel

Array = NDArray[Any]


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

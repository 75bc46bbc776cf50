"""exp and log by arithmetic alone, compiled: the same operations, hence the same bits, as in the tensor form."""

from __future__ import annotations

import math
from typing import Any

from fmtorch.compiling.kernel import inner

ROOT2, LOG2 = math.sqrt(2), math.log(2)


@inner
def exponential(x: Any) -> Any:
    """exp(x) for |x| up to about 5: Pade's approximant of order 4 at x / 32, and five squarings. Of tensors, too."""
    y = x / 32
    y2 = y * y
    even, odd = 1680 + y2 * (180 + y2), y * (840 + 20 * y2)
    value = (even + odd) / (even - odd)
    for _ in range(5):
        value = value * value
    return value


@inner
def logarithm(x: float) -> Any:
    """ln(x) of a positive number: the series of atanh at the mantissa."""
    mantissa, exponent = math.frexp(x)
    m = mantissa * ROOT2
    z = (m - 1) / (m + 1)
    z2 = z * z
    series = 1 / 19
    for k in range(17, 0, -2):
        series = series * z2 + 1 / k
    return 2 * z * series + (exponent - 0.5) * LOG2

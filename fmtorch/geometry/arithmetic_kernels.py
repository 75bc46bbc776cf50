"""exp and log by arithmetic alone, compiled: the same operations, hence the same bits, as in the tensor form.

Functions of the C library differ in the last bit from version to version.
"""

from __future__ import annotations

import math
from typing import Any

from fmtorch.compiling.kernel import inner

ROOT2, LOG2, LOG10 = math.sqrt(2), 0.6931471805599453, 2.302585092994046


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
    return twice_atanh((m - 1) / (m + 1)) + (exponent - 0.5) * LOG2


@inner
def logarithm_1p(x: float) -> Any:
    """ln(1 + x) for x > -1, to rounding also near 0."""
    if -0.25 < x < 0.4:
        return twice_atanh(x / (x + 2))
    return logarithm(1 + x) if x < math.inf else x


@inner
def twice_atanh(z: Any) -> Any:
    """ln((1 + z) / (1 - z)) for |z| up to (sqrt 2 - 1) / (sqrt 2 + 1), to rounding, by its series. Of tensors, too."""
    z2 = z * z
    series = z2 * (1 / 19) + 1 / 17
    for k in range(15, 0, -2):
        series = series * z2 + 1 / k
    return 2 * z * series

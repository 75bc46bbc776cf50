"""MAGSAC++: residuals judged by all noise scales at once (Barath et al., CVPR 2020, section 3): its loss in tables.

For residuals of n = 4 degrees of freedom and a noise scale that is uniform in (0, sigma_max], the loss of a match is
``rho(r) = sigma_max^2/2 lower(5/2, x) + r^2/4 (upper(3/2, x) - upper(3/2, k^2/2))`` with ``x = r^2 / (2 sigma_max^2)``
and the incomplete gamma functions, constant from ``r = k sigma_max`` on; k = 3.64 is the 0.99 quantile of the residual.
Its derivative, the weight of a match in their sigma-consensus++, is ``(upper(3/2, x) - upper(3/2, k^2/2)) / 4``.
Both are functions of ``u = (r / (k sigma_max))^2`` here. They are looked up rather than evaluated, as by the authors.
"""

from __future__ import annotations

import numpy as np

from fmtorch.compiling.arrays import Array

QUANTILE = 3.64
ENTRIES = 2048  # intervals of u in [0, 1] between which the tabulated weight is linear: off by at most 3e-5
TERMS = 40  # of series in x up to QUANTILE^2 / 2: what is left out is below a rounding error
END = np.array([QUANTILE**2 / 2])


def marginal_loss(u: Array) -> Array:
    """rho / sigma_max^2, for u in [0, 1]."""
    x = u * END
    loss: Array = _lower_gamma(2.5, x) / 2 + x / 2 * (_lower_gamma(1.5, END) - _lower_gamma(1.5, x))
    return loss


def marginal_weight(u: Array) -> Array:
    """The derivative of the loss by r^2 over that at zero, for u in [0, 1]."""
    return 1 - _lower_gamma(1.5, u * END) / _lower_gamma(1.5, END)


def _lower_gamma(s: float, x: Array) -> Array:
    """The lower incomplete gamma function of s, 3/2 or 5/2, of x from 0 to about 7.

    ``x^s exp(-x) sum_n x^n / (s (s + 1) ... (s + n))``, and exp by its series, too: sums of positive terms, by
    arithmetic alone, so that tables made of it are the same on every processor.
    """
    total, exponential = np.zeros_like(x), np.ones_like(x)
    for n in range(TERMS, -1, -1):
        total = (total * x + 1) / (s + n)
        exponential = exponential * x / (n + 1) + 1
    power = x * np.sqrt(x) if s == 1.5 else x * x * np.sqrt(x)
    gamma: Array = power * total / exponential
    return gamma


def _loss_table() -> Array:
    weight = np.append(marginal_weight(np.arange(ENTRIES + 1) / ENTRIES), 0.0)
    integral = np.append(0.0, np.cumsum((weight[:-1] + weight[1:]) / (2 * ENTRIES)))
    return np.stack([weight, integral])


def _gain_table() -> Array:
    middle = (np.arange(ENTRIES) + 0.5) / ENTRIES
    return np.append(1 - marginal_loss(middle) / marginal_loss(np.ones(1)), 0.0).astype(np.float32)


LOSS_TABLE = _loss_table()
"""The weight at the ends of the intervals, zero beyond u = 1, and its integral up to each of them, (2, ENTRIES + 2)."""
GAIN_TABLE = _gain_table()
"""1 - rho / rho_max in the middle of each interval, and 0 from u = 1 on, (ENTRIES + 1,) float32."""

"""Robust losses: functions of a squared residual that grow more slowly than the residual itself.

Each is scaled so that ``loss ~ r^2`` for small residuals; ``weight = d loss / d r^2`` is then 1 at zero, and minimising
``sum weight * r^2`` with the weights held fixed, again and again, minimises the sum of losses (IRLS).
`r2` is the squared residual, `s2` the squared scale in the same unit; both broadcast.
Zhang (1997), "Parameter estimation techniques", table 1; Torr & Zisserman (2000) for the truncated one;
Barath et al. (2020) for that of MAGSAC++, whose scale is k sigma_max, the distance from which on nothing counts.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.kernel import Array

QUANTILE = 3.64
ENTRIES = 2048  # intervals of u in [0, 1] between which the tabulated weight is linear: off by at most 3e-5
TERMS = 40  # of series in x up to QUANTILE^2 / 2: what is left out is below a rounding error
END = np.array([QUANTILE**2 / 2])


def marginal_loss(u: Array) -> Array:
    """rho / sigma_max^2, for u in [0, 1]."""
    x = u * END
    return np.asarray(_lower_gamma(2.5, x) / 2 + x / 2 * (_lower_gamma(1.5, END) - _lower_gamma(1.5, x)))


def _lower_gamma(s: float, x: Array) -> Array:
    """The lower incomplete gamma function of s, 3/2 or 5/2, of x from 0 to about 7.
    ``x^s exp(-x) sum_n x^n / (s (s + 1) ... (s + n))``, and exp by its series, too: sums of positive terms, by
    arithmetic alone, so that tables made of it are the same on every processor."""
    total, exponential = np.zeros_like(x), np.ones_like(x)
    for n in range(TERMS, -1, -1):
        total = (total * x + 1) / (s + n)
        exponential = exponential * x / (n + 1) + 1
    power = x * np.sqrt(x) if s == 1.5 else x * x * np.sqrt(x)
    return power * total / exponential


_u = np.arange(ENTRIES + 1) / ENTRIES
_weight = np.append(1 - _lower_gamma(1.5, _u * END) / _lower_gamma(1.5, END), 0.0)  # the slope over that at zero
_integral = np.append(0.0, np.cumsum((_weight[:-1] + _weight[1:]) / (2 * ENTRIES)))
LOSS_TABLE = np.stack([_weight, _integral])
"""The weight at the ends of the intervals, zero beyond u = 1, and its integral up to each of them, (2, ENTRIES + 2)."""
_gain = 1 - marginal_loss((np.arange(ENTRIES) + 0.5) / ENTRIES) / marginal_loss(np.ones(1))
GAIN_TABLE = np.append(_gain, 0.0).astype(np.float32)
"""1 - rho / rho_max in the middle of each interval, and 0 from u = 1 on, (ENTRIES + 1,) float32."""

_WEIGHT = torch.from_numpy(LOSS_TABLE[0])


class RobustLoss(NamedTuple):
    """The derivative of a robust loss with respect to r^2, and its curvature, both functions of (r2, s2).
    curvature: half the second derivative with respect to r, ``rho' + 2 r^2 rho''``, and 0 where that is negative."""

    weight: Callable[[Tensor, Tensor], Tensor]
    curvature: Callable[[Tensor, Tensor], Tensor]


def huber_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale s, ``s / |r|`` beyond (Huber 1964)."""
    return sqrt(s2 / torch.maximum(r2, s2))


def within_scale(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale, 0 beyond: the curvature of Huber's loss, and both derivatives of the truncated one,
    ``min(r^2, s^2)``: MSAC. An infinite scale gives plain least squares."""
    return (r2 <= s2).to(r2.dtype)


def cauchy_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 / (s^2 + r^2)``."""
    return s2 / (s2 + r2)


def cauchy_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 (s^2 - r^2) / (s^2 + r^2)^2``, or 0."""
    return s2 / (s2 + r2) * ((s2 - r2) / (s2 + r2)).clamp_min(0)


def geman_mcclure_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 / (s^2 + r^2)^2``."""
    return (s2 / (s2 + r2)).square()


def geman_mcclure_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 (s^2 - 3 r^2) / (s^2 + r^2)^3``, or 0."""
    return geman_mcclure_weight(r2, s2) * ((s2 - 3 * r2) / (s2 + r2)).clamp_min(0)


def tabulated_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """That of MAGSAC++ over its slope at zero, from the table: 1 at zero, 0 from s = k sigma_max on."""
    _, share, weight, step = _look_up(r2, s2)
    return (weight + share * step).to(r2.dtype)


def tabulated_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """Half the second derivative of the tabulated loss by r, or 0 where that is negative."""
    interval, share, weight, step = _look_up(r2, s2)
    slope = 2 * (interval + share) * step  # 2 r^2 rho''; intervals are of length 1 / ENTRIES
    return (weight + share * step + slope).clamp_min(0).to(r2.dtype)


def _look_up(r2: Tensor, s2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The interval of u, the share of it that lies below u, the weight at its beginning, and how much that rises."""
    position = (r2 / s2 * ENTRIES).clamp(0, ENTRIES).to(torch.float64)
    interval = position.nan_to_num(nan=0).to(torch.int64)  # what is NaN stays so by its share
    table = _WEIGHT.to(r2.device)
    weight = torch.take(table, interval)
    return interval, position - interval, weight, torch.take(table, interval + 1) - weight


LOSSES: dict[str, RobustLoss] = {
    "huber": RobustLoss(huber_weight, within_scale),
    "cauchy": RobustLoss(cauchy_weight, cauchy_curvature),
    "geman_mcclure": RobustLoss(geman_mcclure_weight, geman_mcclure_curvature),
    "truncated": RobustLoss(within_scale, within_scale),
    "magsac": RobustLoss(tabulated_weight, tabulated_curvature),
}


def named_loss(name: str) -> RobustLoss:
    """The loss of that name; a ValueError that lists the names where there is none."""
    if name not in LOSSES:
        raise ValueError(f"loss is {name!r}; it must be one of: {', '.join(LOSSES)}")
    return LOSSES[name]

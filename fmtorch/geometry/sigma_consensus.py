"""MAGSAC++: residuals judged by all noise scales at once (Barath et al., CVPR 2020, section 3).

For residuals of n = 4 degrees of freedom and a noise scale that is uniform in (0, sigma_max], the loss of a match is
``rho(r) = sigma_max^2/2 lower(5/2, x) + r^2/4 (upper(3/2, x) - upper(3/2, k^2/2))`` with ``x = r^2 / (2 sigma_max^2)``
and the incomplete gamma functions, constant from ``r = k sigma_max`` on; k = 3.64 is the 0.99 quantile of the residual.
Its derivative, the weight of a match in their sigma-consensus++, is ``(upper(3/2, x) - upper(3/2, k^2/2)) / 4``.
Both are functions of ``u = (r / (k sigma_max))^2`` here.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import sqrt

QUANTILE = 3.64
ENTRIES = 2048  # intervals of u in [0, 1] between which the tabulated weight is linear: off by at most 3e-5

_END = torch.tensor(QUANTILE**2 / 2, dtype=torch.float64)
_TERMS = 40  # of series in x up to QUANTILE^2 / 2: what is left out is below a rounding error


def marginal_loss(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """rho / sigma_max^2, for u in [0, 1]."""
    x = u * _END
    return _lower_gamma(2.5, x) / 2 + x / 2 * (_lower_gamma(1.5, _END) - _lower_gamma(1.5, x))


def marginal_weight(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The derivative of the loss by r^2 over that at zero, for u in [0, 1]."""
    return 1 - _lower_gamma(1.5, u * _END) / _lower_gamma(1.5, _END)


def _lower_gamma(s: float, x: Tensor) -> Tensor:
    """The lower incomplete gamma function of s, 3/2 or 5/2, of x from 0 to about 7.

    ``x^s exp(-x) sum_n x^n / (s (s + 1) ... (s + n))``, and exp by its series, too: sums of positive terms, by
    arithmetic alone, so that tables made of it are the same on every processor.
    """
    total, exponential = torch.zeros_like(x), torch.ones_like(x)
    for n in range(_TERMS, -1, -1):
        total = (total * x + 1) / (s + n)
        exponential = exponential * x / (n + 1) + 1
    power = x * sqrt(x) if s == 1.5 else x * x * sqrt(x)
    return power * total / exponential


# The weight at the ends of the intervals, zero beyond u = 1, and its integral up to each of them. Looked up rather than
# evaluated, as by the authors.
_WEIGHT = marginal_weight(torch.arange(ENTRIES + 1, dtype=torch.float64) / ENTRIES)
_WEIGHT = torch.cat([_WEIGHT, _WEIGHT.new_zeros(1)])
_INTEGRAL = torch.nn.functional.pad(((_WEIGHT[:-1] + _WEIGHT[1:]) / (2 * ENTRIES)).cumsum(0), (1, 0))
LOSS_TABLE = torch.stack([_WEIGHT, _INTEGRAL]).numpy()  # as kernels take both


def tabulated_loss(r2: Tensor, s2: Tensor) -> Tensor:
    """The loss over its slope at zero, from the table; s = k sigma_max."""
    interval, share, weight, step = _look_up(r2, s2)
    inside = (weight + share * step / 2) * share / ENTRIES
    loss: Tensor = s2 * (torch.take(_INTEGRAL.to(r2.device), interval) + inside)
    return loss.to(r2.dtype)


def tabulated_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """The weight, from the table: 1 at zero, 0 from s on."""
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

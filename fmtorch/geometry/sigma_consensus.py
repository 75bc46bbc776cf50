"""MAGSAC++: residuals judged by all noise scales at once (Barath et al., CVPR 2020, section 3).

For residuals of n = 4 degrees of freedom and a noise scale that is uniform in (0, sigma_max], the loss of a match is
``rho(r) = sigma_max^2/2 lower(5/2, x) + r^2/4 (upper(3/2, x) - upper(3/2, k^2/2))`` with ``x = r^2 / (2 sigma_max^2)``
and the incomplete gamma functions, constant from ``r = k sigma_max`` on; k = 3.64 is the 0.99 quantile of the residual.
Its derivative, the weight of a match in their sigma-consensus++, is ``(upper(3/2, x) - upper(3/2, k^2/2)) / 4``.
Both are functions of ``u = (r / (k sigma_max))^2`` here.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

QUANTILE = 3.64
ENTRIES = 2048  # intervals of u in [0, 1] between which the tabulated weight is linear: off by at most 3e-5

_END = torch.tensor(QUANTILE**2 / 2, dtype=torch.float64)


def marginal_loss(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """rho / sigma_max^2, for u in [0, 1]."""
    x = u * _END
    return _lower_gamma_5_2(x) / 2 + x / 2 * (_upper_gamma_3_2(x) - _upper_gamma_3_2(_END))


def marginal_weight(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The derivative of the loss by r^2 over that at zero, for u in [0, 1]."""
    zero = torch.zeros_like(_END)
    rest = _upper_gamma_3_2(_END)
    weight: Tensor = (_upper_gamma_3_2(u * _END) - rest) / (_upper_gamma_3_2(zero) - rest)
    return weight


def _upper_gamma_3_2(x: Tensor) -> Tensor:
    """The upper incomplete gamma function of 3/2."""
    value: Tensor = x.sqrt() * torch.exp(-x) + math.sqrt(math.pi) / 2 * torch.special.erfc(x.sqrt())
    return value


def _lower_gamma_5_2(x: Tensor) -> Tensor:
    """The lower incomplete gamma function of 5/2."""
    return 0.75 * math.sqrt(math.pi) - 1.5 * _upper_gamma_3_2(x) - x * x.sqrt() * torch.exp(-x)


# The weight at the ends of the intervals, zero beyond u = 1, and its integral up to each of them. Looked up rather than
# evaluated, as by the authors, and because the last bits of exp depend on where in a batch its argument stands.
_WEIGHT = torch.cat(
    [marginal_weight(torch.linspace(0, 1, ENTRIES + 1, dtype=torch.float64)), torch.zeros(1, dtype=torch.float64)]
)
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


def gain_table() -> NDArray[np.float32]:
    """The gains of MAGSAC++ in ENTRIES intervals of (r / (k sigma_max))^2, and 0 from there on; float32."""
    middle = (torch.arange(ENTRIES, dtype=torch.float64) + 0.5) / ENTRIES
    gain = 1 - marginal_loss(middle) / marginal_loss(torch.ones_like(middle))
    table: NDArray[np.float32] = torch.cat([gain, torch.zeros(1, dtype=torch.float64)]).to(torch.float32).numpy()
    return table

"""The loss of MAGSAC++ for tensors, from the tables of `magsac`."""

from __future__ import annotations

import torch
from torch import Tensor

from fmtorch.geometry.magsac import ENTRIES, LOSS_TABLE

_WEIGHT, _INTEGRAL = torch.from_numpy(LOSS_TABLE).unbind(0)


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

"""Robust losses (kernels): functions of a squared residual that grow more slowly than the residual itself.

Each is scaled so that ``loss ~ r^2`` for small residuals; ``weight = d loss / d r^2`` is then 1 at zero, and minimising
``sum weight * r^2`` with the weights held fixed, again and again, minimises the sum of losses (IRLS).
`r2` is the squared residual, `s2` the squared scale in the same unit; both broadcast.
Zhang (1997), "Parameter estimation techniques", table 1; Torr & Zisserman (2000) for the truncated one;
Barath et al. (2020) for that of MAGSAC++, whose scale is k sigma_max, the distance from which on nothing counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from fmtorch.geometry.arithmetic import logarithm_1p, sqrt
from fmtorch.geometry.sigma_consensus import tabulated_curvature, tabulated_loss, tabulated_weight


class Kernel(NamedTuple):
    """A robust loss, its derivative with respect to r^2, and its curvature, all functions of (r2, s2).

    curvature: half the second derivative with respect to r, ``rho' + 2 r^2 rho''``, and 0 where that is negative.
    """

    loss: Callable[[Tensor, Tensor], Tensor]
    weight: Callable[[Tensor, Tensor], Tensor]
    curvature: Callable[[Tensor, Tensor], Tensor]


def huber_loss(r2: Tensor, s2: Tensor) -> Tensor:
    """``r^2`` up to the scale s, ``2 s |r| - s^2`` beyond (Huber 1964)."""
    return torch.where(r2 <= s2, r2, 2 * sqrt(s2 * torch.maximum(r2, s2)) - s2)


def huber_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale s, ``s / |r|`` beyond."""
    return sqrt(s2 / torch.maximum(r2, s2))


def huber_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale, 0 beyond."""
    return (r2 <= s2).to(r2.dtype)


def cauchy_loss(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 log(1 + r^2 / s^2)``."""
    return s2 * logarithm_1p(r2 / s2)


def cauchy_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 / (s^2 + r^2)``."""
    return s2 / (s2 + r2)


def cauchy_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 (s^2 - r^2) / (s^2 + r^2)^2``, or 0."""
    return s2 / (s2 + r2) * ((s2 - r2) / (s2 + r2)).clamp_min(0)


def geman_mcclure_loss(r2: Tensor, s2: Tensor) -> Tensor:
    """``r^2 s^2 / (s^2 + r^2)``."""
    return r2 * (s2 / (s2 + r2))


def geman_mcclure_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 / (s^2 + r^2)^2``."""
    return (s2 / (s2 + r2)).square()


def geman_mcclure_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 (s^2 - 3 r^2) / (s^2 + r^2)^3``, or 0."""
    return geman_mcclure_weight(r2, s2) * ((s2 - 3 * r2) / (s2 + r2)).clamp_min(0)


def truncated_loss(r2: Tensor, s2: Tensor) -> Tensor:
    """``min(r^2, s^2)``: MSAC. An infinite scale gives plain least squares."""
    return torch.minimum(r2, s2)


def truncated_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale, 0 beyond."""
    return (r2 <= s2).to(r2.dtype)


KERNELS: dict[str, Kernel] = {
    "huber": Kernel(huber_loss, huber_weight, huber_curvature),
    "cauchy": Kernel(cauchy_loss, cauchy_weight, cauchy_curvature),
    "geman_mcclure": Kernel(geman_mcclure_loss, geman_mcclure_weight, geman_mcclure_curvature),
    "truncated": Kernel(truncated_loss, truncated_weight, truncated_weight),
    "magsac": Kernel(tabulated_loss, tabulated_weight, tabulated_curvature),
}


def named_kernel(name: str) -> Kernel:
    """The kernel of that name; a ValueError that lists the names where there is none."""
    if name not in KERNELS:
        raise ValueError(f"kernel is {name!r}; it must be one of: {', '.join(KERNELS)}")
    return KERNELS[name]

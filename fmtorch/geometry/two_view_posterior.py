"""The covariance of two-view parameters that information and priors leave, in tensors; see `two_view_covariance`.

Matrices are (7, 7, b) and (2, 2, b).
"""

from __future__ import annotations

import torch
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.two_view_information import PARAMETERS

DIFFUSE = (1.33, 1.33, 1.33, 1.21, 1.21, 2.3, 2.3)
"""Deviations that no parameter exceeds: of a rotation and a direction drawn uniformly (radians, each axis), and a
factor of ten in a focal length. They enter as independent information, which is nothing beside that of matches."""


def directions(known: Tensor, shared: Tensor) -> Tensor:
    """How the parameters move (7, 7, b), by the columns: a known one never, shared ones together by the first's."""
    b = len(known)
    used = torch.eye(PARAMETERS, dtype=torch.float64, device=known.device)[..., None].repeat(1, 1, b)
    any_known, together = known.any(-1), shared & ~known.any(-1)
    used[5, 5] = (~(known[:, 0] | (shared & any_known))).to(used.dtype)
    used[6, 6] = (~(known[:, 1] | shared)).to(used.dtype)
    used[6, 5] = together.to(used.dtype)
    return used


def covariance_of(information: Tensor, Pi: Tensor, used: Tensor) -> Tensor:
    """The inverse (7, 7, b) of information, prior and `DIFFUSE` in the directions that are used; zero in others."""
    total = information + torch.diag(information.new_tensor(DIFFUSE) ** -2)[..., None]
    prior = torch.nn.functional.pad(_positive_part(Pi).movedim(-1, 0), (5, 0, 5, 0)).movedim(0, -1)
    reduced = product_of(used.transpose(0, 1), product_of(total + prior, used))
    idle = 1 - used.amax(0)
    eye = torch.eye(PARAMETERS, dtype=total.dtype, device=total.device)[..., None]
    M = torch.cat([reduced + eye * idle, eye.expand_as(reduced)], 1)
    for k in range(PARAMETERS):  # Gauss and Jordan, of a positive definite matrix without pivots
        M = M - (M[:, k] - eye[:, k])[:, None] * (M[k] / M[k, k])[None]
    inverse = M[:, PARAMETERS:] * (1 - idle) * (1 - idle)[:, None]
    C = product_of(used, product_of(inverse, used.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def without(C: Tensor, from_noise: Tensor) -> Tensor:
    """The covariance (7, 7, b) with information (2, 2, b) about the direction of translation taken away.

    The other parameters keep their distribution given that direction, whose own covariance becomes larger. What
    `DIFFUSE` knows of it stays.
    """
    S, eye = _inverse(C[3:5, 3:5]), torch.eye(2, dtype=C.dtype, device=C.device)[..., None]
    floor = eye * DIFFUSE[3] ** -2
    grown = _inverse(_positive_part(S - from_noise - floor) + floor)
    by_direction = product_of(C[:, 3:5], S)
    C = C + product_of(by_direction, product_of(grown - C[3:5, 3:5], by_direction.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def _inverse(A: Tensor) -> Tensor:
    """Of symmetric matrices (2, 2, b)."""
    adjugate = torch.stack([torch.stack([A[1, 1], -A[0, 1]]), torch.stack([-A[0, 1], A[0, 0]])])
    return adjugate / (A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1])


def _positive_part(Pi: Tensor) -> Tensor:
    """Symmetric matrices (2, 2, b) with their negative eigenvalues set to zero."""
    a, b, c = Pi[0, 0], (Pi[0, 1] + Pi[1, 0]) / 2, Pi[1, 1]
    mean, half = (a + c) / 2, (a - c) / 2
    radius = sqrt(half * half + b * b)
    high, low = (mean + radius).clamp_min(0), (mean - radius).clamp_min(0)
    turn = torch.where(radius > 0, 1 / torch.where(radius > 0, radius, 1.0), 0.0)
    middle, part = (high + low) / 2, (high - low) / 2 * turn
    return torch.stack([torch.stack([middle + part * half, part * b]), torch.stack([part * b, middle - part * half])])


def product_of(A: Tensor, B: Tensor) -> Tensor:
    """``A B`` of component-first matrices of any size."""
    return component_sum(A[:, :, None] * B[None], 1)

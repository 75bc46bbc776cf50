"""The candidates of one pair refined with the prior on focal lengths, compiled: one call for all of its parts.

table: (9, n), of `OnePair`. offset: (4,), from its points to those from the principal points. longest: (2,), the longer
sides of the images in the unit of the points. scale_px, loss, loss_table, precision, iterations: of `minimise`.
parallel: the tolerance of `share_in_front`. Cameras -> axes (k, 2, 3, 3), focal (k, 2), models (k, 9), what the prior
costs -> cost (k,), shares of the support in front of both cameras -> share (k,).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.estimators.focal.cameras_kernels import centre, nearest_cameras
from fmtorch.estimators.focal.cheirality_kernels import share_in_front
from fmtorch.estimators.focal.posterior_kernels import minimise, models_and_costs
from fmtorch.estimators.pool_kernels import near

Array = NDArray[Any]


PRIOR = (
    "f8[::1], f8[::1], b1, f8, i8, f8[:, ::1], f8, f8, i8, f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1]"
)


@kernel("f4[:, ::1], f4[:, ::1], f4, i8, i8, i8, f8[:, ::1], " + PRIOR)
def refine_near_with_prior(
    F: Array, points: Array, limit: Any, mixed_seed: int, key: int, most: int, table: Array, offset: Array,
    longest: Array, same_size: bool, scale_px: float, loss: int, loss_table: Array, precision: float, parallel: float,
    iterations: int, axes: Array, focal: Array, models: Array, cost: Array, share: Array,
) -> None:  # fmt: skip
    """`refine_with_prior` on at most so many matches, those that `near` draws. F: float32; points: (4, n), float32."""
    index = np.empty(min(most, points.shape[1]), np.int64)
    count = near(F, points, limit, mixed_seed, key, index)
    chosen = np.empty((9, count))
    for r in range(9):
        for i in range(count):
            chosen[r, i] = table[r, index[i]]
    refine_with_prior(
        F.astype(np.float64), chosen, offset, longest, same_size, scale_px, loss, loss_table, precision, parallel,
        iterations, axes, focal, models, cost, share,
    )  # fmt: skip


@kernel("f8[:, ::1], f8[:, ::1], " + PRIOR)
def refine_with_prior(
    F: Array, table: Array, offset: Array, longest: Array, same_size: bool, scale_px: float, loss: int,
    loss_table: Array, precision: float, parallel: float, iterations: int, axes: Array, focal: Array, models: Array,
    cost: Array, share: Array,
) -> None:  # fmt: skip
    """As `posterior.refine_with_prior`, of models (k, 9)."""
    k, matches = len(F), np.empty((6, table.shape[1]))
    found, least, gradient, hessian = np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7))
    centre(table, offset, scale_px, matches)
    points, s2, scale = matches[:4], matches[4], matches[5]
    nearest_cameras(F, offset, longest, axes, focal)
    minimise(
        axes, focal, points, table[4], s2, loss, loss_table, longest, same_size, precision, iterations, -1.0, found,
        least, gradient, hessian,
    )  # fmt: skip
    models_and_costs(found, least, focal, offset, same_size, models, cost)
    share_in_front(axes, focal, longest, found, points, table[6], scale, parallel, share)

"""A round of samples of five, from their draws to candidates with posteriors, compiled: one call for all of its parts.

What is told of the pair, in the order of the parts that take it:
samples, as of `samples_of_five`: table, totals, newest, order, normal, numbers, same_size, longest, sampling_seed,
focal_seed, key, centred (its points), offset; verification, as of `verify_by_saturated_gains`: few, few_support,
few_scale, few_bits, gain, gain_table, points, support, scale, cells, bits; refinement, as of `refine_near_with_prior`:
limit, near_seed, most, matches (its table), scale_px, loss, loss_table, precision, parallel, iterations; selection, as
of `score_saturated`: narrow_points, narrow_support, narrow_scale, narrow_cells, narrow_bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.estimators.focal.hypotheses_kernels import SOLUTIONS, samples_of_five
from fmtorch.estimators.focal.refined_kernels import refine_near_with_prior
from fmtorch.estimators.focal.selection_kernels import posteriors
from fmtorch.estimators.pool_kernels import merge
from fmtorch.estimators.scores_kernels import score_saturated
from fmtorch.estimators.verify_kernels import verify_by_saturated_gains

Array = NDArray[Any]
OF_MATCHES = "f4[:, ::1], f4[::1], f4[::1], "
SAMPLES = "i8[::1], i8[::1], i8[::1], i8[::1], f8[::1], f8[::1], b1, f8[::1], i8, i8, i8, f8[:, ::1], f8[::1], "
VERIFICATION = OF_MATCHES + "i8, i8, f4[::1], " + OF_MATCHES + "i4[:, ::1], i8, "
REFINEMENT = "f4, i8, i8, f8[:, ::1], f8, i8, f8[:, ::1], f8, f8, i8, "
SELECTION = OF_MATCHES + "i4[:, ::1], i8, "


@kernel(
    SAMPLES + VERIFICATION + REFINEMENT + SELECTION
    + "i8, i8, i8, f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1]"
)  # fmt: skip
def candidates_of_five(
    table: Array, totals: Array, newest: Array, order: Array, normal: Array, numbers: Array, same_size: bool,
    longest: Array, sampling_seed: int, focal_seed: int, key: int, centred: Array, offset: Array,
    few: Array, few_support: Array, few_scale: Array, few_bits: int, gain: int, gain_table: Array, points: Array,
    support: Array, scale: Array, cells: Array, bits: int,
    limit: Any, near_seed: int, most: int, matches: Array, scale_px: float, loss: int, loss_table: Array,
    precision: float, parallel: float, iterations: int,
    narrow_points: Array, narrow_support: Array, narrow_scale: Array, narrow_cells: Array, narrow_bits: int,
    start: int, count: int, survivors: int, axes: Array, focal: Array, models: Array, cost: Array, share: Array,
    posterior: Array,
) -> int:  # fmt: skip
    """The best of `count` draws from `start` on, refined; how many they are, at most len(posterior).

    survivors: models that are scored on all matches. Cameras -> axes (k, 2, 3, 3), focal (k, 2), models (k, 9), what
    the prior costs -> cost (k,), shares in front -> share (k,), posteriors -> posterior (k,).
    """
    F, draw = np.empty((SOLUTIONS * count, 9), np.float32), np.empty(SOLUTIONS * count, np.int64)
    m = samples_of_five(
        table, totals, newest, order, normal, numbers, same_size, longest, sampling_seed, focal_seed, key, start,
        centred, offset, np.empty((5, count), np.int64), F, draw,
    )  # fmt: skip
    which, score = np.empty(min(m, survivors), np.int64), np.empty(min(m, survivors))
    verify_by_saturated_gains(
        F[:m], few, few_support, few_scale, few_bits, gain, gain_table, points, support, scale, cells, bits, which,
        score,
    )  # fmt: skip
    best, best_score = np.zeros((len(posterior), 9), np.float32), np.full(len(posterior), -math.inf)
    k = merge(F[:m], which, score, 0, best, best_score)
    if k == 0:
        return 0
    refine_near_with_prior(
        best[:k], points, limit, near_seed, key, most, matches, offset, longest, same_size, scale_px, loss, loss_table,
        precision, parallel, iterations, axes[:k], focal[:k], models[:k], cost[:k], share[:k],
    )  # fmt: skip
    worth = np.empty(k)
    score_saturated(
        models[:k].astype(np.float32), np.arange(k), narrow_points, narrow_support, narrow_scale, narrow_cells,
        narrow_bits, worth,
    )  # fmt: skip
    posteriors(worth, share[:k], cost[:k], np.ones(k, np.bool_), posterior[:k])
    return k

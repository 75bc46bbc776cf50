"""Estimates of the pairs of a batch by a kernel form, one pair after the other from its matches to its verdict.

As `estimators.batching` of tensors without gradients: the same reasons, and the same numbers to the bit. What stands
beside a pair in the batch is never looked at. Pairs are shared out among threads, which changes no result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from fmtorch.core.threads import available, mapped
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.batching import NOT_FINITE, shared_out
from fmtorch.estimators.one_pair.door import Arrived, Rows, opened
from fmtorch.estimators.one_pair.exit import lack_of_support, rounding_of, to_pixels
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.support import relative_rounding
from fmtorch.geometry.significance import of_one_pair


def estimated(c: Correspondences, seed: int, least: int, solve: Callable[[OnePair], Any], not_found: str) -> Estimate:
    """As `batching.solve_all`; solve: makes the outcome of one pair, `Form.__call__` in its kernel form."""
    b, n = c.mask.shape
    rows, rounding = Rows.of(c), relative_rounding(c.x0.dtype)
    F, inliers, ok = np.zeros((b, 3, 3)), np.zeros((b, n), np.bool_), np.zeros(b, np.bool_)
    draws, significance, reasons = np.zeros(b, np.int64), np.full(b, -np.inf), [""] * b

    def one(i: int) -> str:
        """Why there is no estimate of a pair; empty where there is one."""
        arrived = Arrived.of(rows, i)
        found = opened(rows, i, arrived, seed, least)
        if isinstance(found, str):
            return found
        pair, slot = found
        outcome = solve(pair)
        draws[i] = outcome.draws
        if not outcome.found:
            return not_found
        if lack := lack_of_support(pair.points, outcome.inliers, least, rounding_of(pair, rounding)):
            return lack
        matrix = to_pixels(outcome.fit.F, pair)
        if matrix is None:
            return NOT_FINITE
        F[i] = matrix
        inliers[i, slot] = outcome.inliers
        significance[i] = of_one_pair(matrix, *arrived)
        ok[i] = True
        return ""

    def some(pairs: Sequence[int]) -> None:
        with np.errstate(all="ignore"):  # infinite or NaN beyond the range of a float, as in tensors
            for i in pairs:
                reasons[i] = one(i)

    parts = [part.tolist() for part in shared_out(c)] if b > 1 and available() > 1 else [range(b)]
    mapped(some, parts)
    made = {"F": F, "inliers": inliers, "ok": ok, "draws": draws, "significance": significance}
    return Estimate.made(reason=tuple(reasons), **{name: torch.from_numpy(value) for name, value in made.items()})

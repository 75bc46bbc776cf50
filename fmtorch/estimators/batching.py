"""From correspondences to an estimate through buckets of like pairs: the frame that batched estimators share."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.support import lack_of_support, relative_rounding
from fmtorch.records import ungraphed
from fmtorch.threads import one_thread
from fmtorch.types import Correspondences, Estimate
from fmtorch.verdict import judged

Solve = Callable[[NormalizedPairs], tuple[Tensor, Tensor, Tensor, Tensor]]
"""Pairs -> F (p, 3, 3) in normalised units, inliers (p, n), found (p,), draws (p,)."""


def solve_all(c: Correspondences, seed: int, least: int, solve: Solve, not_found: str, limit: int) -> Estimate:
    """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`.

    least: matches below which a pair is not tried, and inliers below which a model is none. not_found: the reason for
    pairs that `solve` does not find a model for. limit: pairs that are solved together; changes no result.
    """
    with one_thread(c.mask.device):
        return ungraphed(c, lambda: _solve_all(c, seed, least, solve, not_found, limit))


def _solve_all(c: Correspondences, seed: int, least: int, solve: Solve, not_found: str, limit: int) -> Estimate:
    b, n = c.mask.shape
    device = c.mask.device
    F = torch.zeros(b, 3, 3, dtype=torch.float64, device=device)
    inliers = torch.zeros(b, n, dtype=torch.bool, device=device)
    draws = torch.zeros(b, dtype=torch.int64, device=device)
    made, reasons = normalized_pairs(c, seed, least)
    limit = max(1, limit)
    for whole in made:
        for first in range(0, len(whole), limit):
            pairs = whole.only(torch.arange(first, min(first + limit, len(whole)), device=device))
            estimate, support, found, drawn = solve(pairs)
            support = support & pairs.mask & found[:, None]
            largest = pairs.centre.abs().amax(1) / pairs.pixels_per_unit + 1
            lacks = lack_of_support(pairs.points.detach(), support, least, largest * relative_rounding(c.x0.dtype))
            supported = torch.tensor([not lack for lack in lacks], device=device)
            F = F.index_copy(0, pairs.row, torch.where(supported[:, None, None], pairs.to_pixels(estimate), 0))
            row, match = (support & supported[:, None]).nonzero(as_tuple=True)
            inliers[pairs.row[row], pairs.slot[row, match]] = True
            draws[pairs.row] = drawn
            for (i, solved), lack in zip(torch.stack([pairs.row, found], 1).tolist(), lacks, strict=True):
                if lack:
                    reasons[i] = lack if solved else not_found
    finite = torch.isfinite(F).flatten(1).all(1)
    F = torch.where(finite[:, None, None], F, 0)
    for i in (~finite).nonzero()[:, 0].tolist():
        reasons.setdefault(i, "the final fit is not finite")
    ok = torch.tensor([i not in reasons for i in range(b)], dtype=torch.bool, device=device)
    return judged(Estimate(F, inliers & ok[:, None], ok, tuple(reasons.get(i, "") for i in range(b)), draws), c)

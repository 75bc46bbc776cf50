"""From correspondences to an estimate through buckets of like pairs: the frame that batched estimators share."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.threads import available, mapped, one_thread
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.support import lack_of_support, relative_rounding
from fmtorch.geometry.verdict import judged

Solve = Callable[[NormalizedPairs], tuple[Tensor, Tensor, Tensor, Tensor]]
"""Pairs -> F (p, 3, 3) in normalised units, inliers (p, n), found (p,), draws (p,)."""


PARTS_OF_A_THREAD = 4  # so that no thread is long alone at the end
MATCHES_AT_LEAST = 500  # a pair of few matches takes as long as one of these
NOT_FINITE = "the final fit is not finite"


def solve_all(
    c: Correspondences, seed: int, least: int, solve: Solve, not_found: str, limit: int, threads: bool = False
) -> Estimate:
    """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`.

    least: matches below which a pair is not tried, and inliers below which a model is none. not_found: the reason for
    pairs that `solve` does not find a model for. limit: pairs that are solved together. threads: whether pairs may be
    shared out among threads. Neither changes a result.
    """

    def solved(part: Correspondences) -> Estimate:
        return ungraphed(part, lambda: _solve_all(part, seed, least, solve, not_found, limit))

    with one_thread(c.mask.device):
        rows = shared_out(c) if threads and available() > 1 else []
        if len(rows) < 2:
            return solved(c)
        return collate(mapped(solved, [c[some] for some in rows]))[torch.argsort(torch.cat(rows))]


def shared_out(c: Correspondences) -> list[Tensor]:
    """The rows of a batch in parts of about equal work, pairs of many matches first."""
    work, order = c.count().clamp_min(MATCHES_AT_LEAST).sort(descending=True)
    before = work.cumsum(0) - work
    part = before * (PARTS_OF_A_THREAD * available()) // max(1, int(work.sum()))
    return list(torch.split(order, torch.unique_consecutive(part, return_counts=True)[1].tolist()))


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
        reasons.setdefault(i, NOT_FINITE)
    ok = torch.tensor([i not in reasons for i in range(b)], dtype=torch.bool, device=device)
    return judged(Estimate(F, inliers & ok[:, None], ok, tuple(reasons.get(i, "") for i in range(b)), draws), c)

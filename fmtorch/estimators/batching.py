"""From correspondences to an estimate through problems of equal size: the frame that batched estimators share."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fmtorch.estimators.problem import Problem, problems
from fmtorch.estimators.support import lack_of_support, relative_rounding
from fmtorch.threads import one_thread
from fmtorch.types import Correspondences, Estimate, ungraphed
from fmtorch.verdict import judged

Solve = Callable[[Problem], tuple[Tensor, Tensor, Tensor, Tensor]]
"""A problem -> F (p, 3, 3) in normalised units, inliers (p, n), found (p,), draws (p,)."""


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
    made, reasons = problems(c, seed, least)
    limit = max(1, limit)
    for whole in made:
        for first in range(0, len(whole.pair), limit):
            problem = whole.only(torch.arange(first, min(first + limit, len(whole.pair)), device=device))
            estimate, support, found, drawn = solve(problem)
            support = support & problem.live & found[:, None]
            largest = problem.centre.abs().amax(1) / problem.unit + 1
            lacks = lack_of_support(problem.points.detach(), support, least, largest * relative_rounding(c.x0.dtype))
            valid = torch.tensor([not lack for lack in lacks], device=device)
            F = F.index_copy(0, problem.pair, torch.where(valid[:, None, None], problem.to_pixels(estimate), 0))
            row, match = (support & valid[:, None]).nonzero(as_tuple=True)
            inliers[problem.pair[row], problem.slot[row, match]] = True
            draws[problem.pair] = drawn
            for (i, solved), lack in zip(torch.stack([problem.pair, found], 1).tolist(), lacks, strict=True):
                if lack:
                    reasons[i] = lack if solved else not_found
    sound = torch.isfinite(F).flatten(1).all(1)
    F = torch.where(sound[:, None, None], F, 0)
    for i in (~sound).nonzero()[:, 0].tolist():
        reasons.setdefault(i, "the final fit is not finite")
    ok = torch.tensor([i not in reasons for i in range(b)], dtype=torch.bool, device=device)
    return judged(Estimate(F, inliers & ok[:, None], ok, tuple(reasons.get(i, "") for i in range(b)), draws), c)

"""Whether two images show one scene: the significance of an estimate, the same for every estimator."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.significance import significance
from fmtorch.jobs.threads import one_thread


def judged(estimate: Estimate, c: Correspondences) -> Estimate:
    """The estimate with its significance, where the estimator has not given one.

    Args:
        estimate: of anybody's estimator.
        c: the matches that it was given, all of them: an estimate from a choice of them must not be judged by these.

    Returns:
        The same with `significance`, minus infinity where it is not ok.
    """
    given = cast(Tensor, estimate.significance)
    unknown = given.isnan()
    if estimate.model != "fundamental" or not bool(unknown.any()):
        return estimate
    with one_thread(c.mask.device):
        computed = significance(estimate.F.detach(), c.x0.detach(), c.x1.detach(), c.mask, c.size0, c.size1)
    computed = torch.where(estimate.ok, computed, -torch.inf)
    return estimate.derived(significance=torch.where(unknown, computed, given))

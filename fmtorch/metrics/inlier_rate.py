"""Share of matches that agree with the ground truth, before and after estimation."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.checked import checked
from fmtorch.geometry.epipolar import epipolar_distances
from fmtorch.metrics.draws import diagonal
from fmtorch.validation import expect_sizes

THRESHOLD = 0.003  # of the image diagonal (Bian et al., BMVC 2019)


class InlierRate(NamedTuple):
    """Inlier rates of the matches given to the estimator and of those it kept; NaN where there are none."""

    before: Tensor
    after: Tensor


@checked
def inlier_rate(
    F_gt: Float[Tensor, "*#batch 3 3"],
    x0: Float[Tensor, "*#batch n 2"],
    x1: Float[Tensor, "*#batch n 2"],
    inliers: Bool[Tensor, "*#batch n"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    threshold: float = THRESHOLD,
) -> InlierRate:
    """Inlier rate before and after estimation, (...), float64: the paper's %Inlier-m and %Inlier as shares.

    Before: the share of the matches in `mask` (all by default) that are ground-truth inliers; after: the same among
    those that are in `inliers` too. NaN where the set is empty. Other arguments as `ground_truth_inliers`.
    """
    correct = ground_truth_inliers(F_gt, x0, x1, size0, size1, mask=mask, threshold=threshold)
    given = torch.ones_like(correct) if mask is None else mask.expand(correct.shape)
    kept = inliers & given
    return InlierRate(_share(correct, given), _share(correct & kept, kept))


@checked
def ground_truth_inliers(
    F_gt: Float[Tensor, "*#batch 3 3"],
    x0: Float[Tensor, "*#batch n 2"],
    x1: Float[Tensor, "*#batch n 2"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    threshold: float = THRESHOLD,
) -> Bool[Tensor, "*#batch n"]:
    """Matches in `mask` whose two distances to their true epipolar lines are both below `threshold` x diagonal.

    x0, x1: (..., N, 2) in pixels. size0, size1: (..., 2) as (h, w); each distance is compared with the diagonal of the
    image in which it is measured. No match is an inlier where F_gt is zero or not finite.
    """
    expect_sizes(size0=size0, size1=size1)
    F_gt, x0, x1 = (value.to(torch.float64) for value in (F_gt, x0, x1))
    d0, d1 = epipolar_distances(F_gt, x0, x1)
    limit0, limit1 = (threshold * diagonal(size.to(torch.float64))[..., None] for size in (size0, size1))
    known = (F_gt.isfinite().all(-1).all(-1) & (F_gt != 0).any(-1).any(-1))[..., None]
    correct = (d0 < limit0) & (d1 < limit1) & known
    return correct if mask is None else correct & mask


def _share(part: Tensor, whole: Tensor) -> Tensor:
    return part.sum(-1).to(torch.float64) / whole.sum(-1).to(torch.float64)

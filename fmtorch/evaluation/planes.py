"""Pairs of known homographies: their errors and inlier rates, of outcomes whose estimator gives homographies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.evaluation.outcomes import joined_correspondences, joined_estimates
from fmtorch.metrics import corner_error, pose_auc, right_of_homography
from fmtorch.pipeline.pipeline import Outcome

THRESHOLDS = (1, 3, 5)  # px, as LightGlue (Lindenberger et al., ICCV 2023); SuperGlue and LoFTR: 3, 5, 10
Values = NDArray[np.float64]


class PlaneFigures(NamedTuple):
    """The corner error in pixels, infinite where the pair failed, and the shares of right matches, NaN if undefined."""

    corner_error: float
    before: float
    after: float


NOTHING = PlaneFigures(math.inf, math.nan, math.nan)


def plane_figures(outcomes: Sequence[Outcome]) -> list[PlaneFigures]:
    """Of each outcome of a pair of a known homography."""
    figures = [NOTHING] * len(outcomes)
    places = [i for i, o in enumerate(outcomes) if o.estimate is not None and o.correspondences is not None]
    if not places:
        return figures
    with_matches = [outcomes[i] for i in places]
    c, estimate = joined_correspondences(with_matches), joined_estimates(with_matches)
    if c.size0 is None:
        raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
    H = torch.stack([torch.from_numpy(np.asarray(o.pair.H, np.float64)) for o in with_matches])
    errors = torch.where(estimate.ok, corner_error(estimate.F, H, c.size0), torch.inf)
    right = right_of_homography(H, c.x0, c.x1, mask=c.mask)
    kept = estimate.inliers & c.mask
    before = right.sum(-1).double() / c.mask.sum(-1)
    after = torch.where(estimate.ok, (right & kept).sum(-1).double() / kept.sum(-1), torch.nan)
    for i, *values in zip(places, errors.tolist(), before.tolist(), after.tolist(), strict=True):
        figures[i] = PlaneFigures(*values)
    return figures


def homography_figures(errors: Values) -> dict[str, float | int | None] | None:
    """Accuracy of homographies over the pairs whose true one is known; None where there is none.

    errors: corner errors in pixels, (n,), infinite where a pair failed, NaN where no homography is known.

    - pairs: how many are known.
    - auc_1, auc_3, auc_5: area under the recall curve of the corner error to 1, 3, 5 px (`fmtorch.metrics.pose_auc`).
    - corner_error: the median, None where that is infinite.
    """
    known = errors[~np.isnan(errors)]
    if not len(known):
        return None
    areas = pose_auc(torch.from_numpy(known), THRESHOLDS).tolist()
    median = float(np.median(known))
    return {
        "pairs": len(known), **{f"auc_{t}px": area for t, area in zip(THRESHOLDS, areas, strict=True)},
        "corner_error": median if math.isfinite(median) else None,
    }  # fmt: skip

"""The errors of the focal lengths that a run estimates, of pairs whose calibrations are known."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.pipeline.pipeline import Outcome


class FocalErrors(NamedTuple):
    """Of both images: ``|f - f_true| / f_true``, and ``log(f / f_true)``.

    None where no focal length was estimated, since it was given exactly or nobody asked, or the true one is not known.
    Where it was to be estimated and is not determined the error is infinite and the ratio None.
    """

    error: tuple[float | None, float | None] = (None, None)
    log_ratio: tuple[float | None, float | None] = (None, None)


def focal_errors(outcome: Outcome) -> FocalErrors:
    """The errors of one pair, by what its estimator was given (`fmtorch.pipeline.examination`)."""
    c, estimate = outcome.correspondences, outcome.estimate
    if c is None or c.focal is None or estimate is None:
        return FocalErrors()
    errors: list[float | None] = []
    ratios: list[float | None] = []
    for i, K in enumerate((outcome.pair.K0, outcome.pair.K1)):
        true = _focal(K)
        exact = float(c.focal[0, i, 1]) == 0
        if true is None or exact:
            errors.append(None)
            ratios.append(None)
            continue
        focal = math.nan if estimate.focals is None or not outcome.solved else float(estimate.focals[0, i])
        determined = math.isfinite(focal) and focal > 0
        errors.append(abs(focal - true) / true if determined else math.inf)
        ratios.append(math.log(focal / true) if determined else None)
    return FocalErrors((errors[0], errors[1]), (ratios[0], ratios[1]))


def _focal(K: NDArray[np.float64] | None) -> float | None:
    """The focal length of a calibration, px: the geometric mean of those along x and y."""
    if K is None or not np.isfinite(K).all():
        return None
    product = float(K[0, 0] * K[1, 1]) / float(K[2, 2]) ** 2 if K[2, 2] else 0.0
    return math.sqrt(product) if product > 0 else None

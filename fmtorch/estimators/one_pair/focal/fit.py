"""`focal.fit` on the arrays of one pair: the maximum a posteriori at the pair's noise, and what the prior costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal.cameras_kernels import translate
from fmtorch.estimators.focal.fit_kernels import gain_without_prior
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras
from fmtorch.estimators.one_pair.focal.posterior import optimum
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.geometry.optimum import STEP_DAMPING


class FocalFit(NamedTuple):
    """As `fit.FocalFit`: a model (9,), its cameras, and what the log likelihood would gain without prior."""

    F: Array
    cameras: TwoCameras
    gain: float


def fit_focal(
    start: TwoCameras, pair: OnePair, truncation: float, sigma: float, iterations: int, tolerance: float
) -> FocalFit:
    """As `fit.fit_focal`."""
    cameras, centred = TwoCameras(start.axes[None].copy(), start.focal[None].copy()), CentredPair.of(pair)
    found = optimum(cameras, pair, "truncated", truncation, sigma, iterations, tolerance)
    F, gain = np.empty((1, 9)), np.empty(1)
    translate(found.F, centred.offset, F)
    gain_without_prior(found.hessian, found.gradient, cameras.focal, centred.same_size, STEP_DAMPING, gain)
    return FocalFit(F[0], cameras.of(0), float(gain[0]))

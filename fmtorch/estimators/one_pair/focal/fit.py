"""`focal.fit` on the arrays of one pair: the maximum a posteriori at the pair's noise, and what the prior costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal.cameras_kernels import translate
from fmtorch.estimators.focal.fit_kernels import gain_without_prior
from fmtorch.estimators.one_pair.focal.cameras import TwoCameras
from fmtorch.estimators.one_pair.focal.posterior import Posterior
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.geometry.levenberg_marquardt import levenberg_marquardt
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
    objective = Posterior(pair, "truncated", truncation, sigma, tolerance)
    state = levenberg_marquardt(objective, (start.axes[None].copy(), start.focal[None].copy()), iterations)
    F, gain = np.empty((1, 9)), np.empty(1)
    translate(state.F, objective.centred.offset, F)
    gain_without_prior(state.hessian, state.gradient, state.focal, objective.centred.same_size, STEP_DAMPING, gain)
    return FocalFit(F[0], TwoCameras(state.axes, state.focal).of(0), float(gain[0]))

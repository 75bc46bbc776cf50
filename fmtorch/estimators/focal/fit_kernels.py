"""What `fit.fit_focal` tells of its optimum, for the candidates of one pair, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.lanes import LANES
from fmtorch.estimators.focal.posterior_kernels import damped_step
from fmtorch.estimators.focal.prior_kernels import focal_cost

Array = NDArray[Any]


@kernel("f8[:, :, ::1], f8[:, ::1], f8[:, ::1], b1, f8, f8[::1]", brief=True)
def gain_without_prior(
    hessian: Array, gradient: Array, focal: Array, same_size: bool, damping: float, out: Array
) -> None:  # fmt: skip
    """What the logarithm of the likelihood would rise by at an optimum without prior -> out (k,)."""
    Q, H, g, work = np.empty((7, LANES)), np.empty((7, 7)), np.empty(7), np.empty(4)
    for k in range(len(focal)):
        focal_cost(focal[k], same_size, work)
        for i in range(7):
            g[i] = gradient[k, i] - (work[i - 5] if i >= 5 else 0.0)
            for j in range(7):
                own = work[2] if i == j else work[3]
                H[i, j] = hessian[k, i, j] - (own if i >= 5 and j >= 5 else 0.0)
        damped_step(H, g, damping, Q)
        total = 0.0
        for i in range(7):
            total += g[i] * Q[i, 7]
        out[k] = -total / 2

"""The loop of `levenberg_marquardt` for kernels: over the models of one pair, the objective a set of inner functions.

So a whole fit is one call, between whose steps nothing waits for Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner

Array = NDArray[Any]


class Schedule(NamedTuple):
    """iterations: steps at most. damping: of the first. tolerance: a model is done once a step has lowered its cost by
    no more than this share of it; 0: none is ever done."""

    iterations: int
    damping: float
    tolerance: float


def levenberg_marquardt(
    evaluate: Callable[..., None], step: Callable[..., None], accept: Callable[..., bool]
) -> Callable[[Any, Any, Any, Array, int, bool], None]:
    """The loop for an objective: loop(data, state, trial, damping, iterations, ends), in place.

    evaluate(state, data, derivatives): the costs, and the derivatives if asked for, at the state's parameters.
    step(state, damping, trial): those of a trial. accept(state, trial, damping, done, data): the trial for the models
    that it improves; whether all are done.
    """

    @inner
    def loop(data: Any, state: Any, trial: Any, damping: Array, iterations: int, ends: bool) -> None:
        """As `levenberg_marquardt.levenberg_marquardt`: the state holds the start, then that of least cost.

        damping: (k,), the first of each model. ends: whether models are ever done; the state then keeps the
        derivatives at the end.
        """
        done = np.zeros(len(damping), np.bool_)
        evaluate(state, data, iterations > 0 or ends)
        for i in range(iterations):
            step(state, damping, trial)
            evaluate(trial, data, i + 1 < iterations or ends)
            if accept(state, trial, damping, done, data) and ends:
                break

    return loop

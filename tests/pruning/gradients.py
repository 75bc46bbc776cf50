"""Gradients held to differences of a slow definition."""

from collections.abc import Callable

import numpy as np
from torch import Tensor


def expect_gradients(fields: dict[str, Tensor], defined: Callable[..., float], step: float = 1e-5) -> None:
    """The gradients of the fields are those of `defined`, a function of their arrays, at some of their entries."""
    rng = np.random.default_rng(0)
    for name, tensor in fields.items():
        for place in rng.choice(tensor.numel(), 3, replace=False):
            values = []
            for change in (step, -step):
                arrays = {other: value.detach().numpy().copy() for other, value in fields.items()}
                arrays[name].reshape(-1)[place] += change
                values.append(defined(**arrays))
            slope = (values[0] - values[1]) / (2 * step)
            # Orders along curves are constants of both; central differences are of order 2.
            assert abs(float(tensor.grad.reshape(-1)[place]) - slope) < 1e-6 * max(1.0, abs(slope)), (name, place)

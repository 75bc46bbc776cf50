"""Random numbers of kernels: those of the tensor form, bit by bit, as their order tells."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.core.random import bits
from fmtorch.core.streams import Stream, mixed_seed
from fmtorch.estimators.parts.preselection import shuffle

pytest.importorskip("numba", reason="numba is not installed")


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, 5, -3, 2**62])
def test_the_same_bits(seed: int, key: int) -> None:
    for stream in (Stream.SAMPLING, Stream.REFINEMENT):
        words = bits(seed, torch.tensor([key]), stream, 0, 1000, 1)[0, :, 0]
        for most in (1, 17, 1000, 2000):
            out = np.empty(most, np.int64)
            count = shuffle(1000, mixed_seed(seed, stream), key, out)
            np.testing.assert_array_equal(out[:count], words.argsort(stable=True)[:most].numpy())

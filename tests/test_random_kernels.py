"""Random numbers of kernels: those of the tensor form, bit by bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.random import Stream, bits, mixed_seed
from fmtorch.random_kernels import random_words

pytest.importorskip("numba", reason="numba is not installed")


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, 5, -3, 2**62])
def test_the_same_bits(seed: int, key: int) -> None:
    out = np.empty(100, np.int64)
    for stream in (Stream.SAMPLING, Stream.REFINEMENT):
        for start in (0, 17, 2**40):
            random_words(mixed_seed(seed, stream), key, start, out)
            expected = bits(seed, torch.tensor([key]), stream, start, 100, 1)[0, :, 0]
            np.testing.assert_array_equal(out, expected.numpy())

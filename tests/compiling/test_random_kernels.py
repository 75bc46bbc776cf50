"""Random numbers of kernels: those of the tensor form and of the definition, bit by bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.compiling.arrays import I8x1
from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.core.random import bits
from fmtorch.core.streams import Stream, mixed_seed
from tests.reference.random import number


@kernel
def numbers(mixed_seed: int, key: int, out: I8x1) -> None:
    state = stream_state(mixed_seed, key)
    for i in range(len(out)):
        out[i] = np.int64(random_bits(state, i))


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, 5, -3, 2**62])
def test_the_same_bits(seed: int, key: int) -> None:
    for stream in (Stream.SAMPLING, Stream.REFINEMENT):
        out = np.empty(1000, np.int64)
        numbers(mixed_seed(seed, stream), key, out)
        np.testing.assert_array_equal(out, bits(seed, torch.tensor([key]), stream, 0, 1000, 1)[0, :, 0].numpy())
        assert out[:5].tolist() == [number(seed, key, stream, i, 0, 1) for i in range(5)]

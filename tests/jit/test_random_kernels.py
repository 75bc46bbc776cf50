"""Random numbers of kernels: those of the definition, and of tensors, bit by bit."""

import numpy as np
import pytest
import torch

from fmtorch.estimators.pair import uniforms
from fmtorch.estimators.preselection import shuffle
from fmtorch.jit.random import Stream, mixed_seed, uniform
from tests.reference.random import number


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, 5, -3, 2**62])
def test_the_same_bits(seed: int, key: int) -> None:
    for stream in (Stream.SAMPLING, Stream.REFINEMENT):
        for start in (0, 2**33):
            out = np.empty((50, 3))
            uniforms(mixed_seed(seed, stream), key, start, out)
            words = [[number(seed, key, stream, start + i, j, 3) for j in range(3)] for i in range(50)]
            assert out.tolist() == [[(word >> 10) / 2**53 for word in row] for row in words]
            tensors = uniform(seed, torch.tensor([key]), stream, start, 50, 3)[0]
            assert out.tolist() == tensors.tolist()
        order = sorted(range(1000), key=lambda i: number(seed, key, stream, 0, i, 1))
        for most in (1, 17, 1000, 2000):
            index = np.empty(most, np.int64)
            count = shuffle(1000, mixed_seed(seed, stream), key, index)
            assert index[:count].tolist() == order[:most]

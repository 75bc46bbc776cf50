"""Random numbers equal splitmix64, in tensors and in kernels."""

import numpy as np
import pytest
import torch

from fmtorch.core import pair_key
from fmtorch.estimators import uniforms
from fmtorch.estimators.preselection import shuffle
from fmtorch.jit.random import Stream, bits, mixed_seed, uniform
from tests.reference import random as reference

KEYS = torch.tensor([0, 1, -1, 2**63 - 1, -(2**63), pair_key("fountain-P11/3-7")])


def test_reference_is_splitmix64() -> None:
    # The first outputs for the seed 1234567, as published with many implementations of splitmix64.
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert [reference.mix((1234567 + i * reference.GAMMA) % reference.WORD) for i in range(1, 5)] == published


def test_known_figures() -> None:
    """Results of old must stay reproducible: a change of these figures changes every run."""
    key = torch.tensor([0, 42])
    assert bits(0, key, Stream.SAMPLING, 0, 1, 2).tolist() == [
        [[368221466943247561, 3991367464249449990]],
        [[815440640363757727, 1861473420936732551]],
    ]
    assert bits(7, key, Stream.PRESELECTION, 1000, 1, 1).tolist() == [[[5900079988694738919]], [[4386968410381171459]]]
    assert uniform(0, key, Stream.METRIC, 0, 1, 2).tolist() == [
        [[0.7448921864807496, 0.6360717220142077]],
        [[0.6698093656441744, 0.6406249460081855]],
    ]


def test_the_global_generator_is_neither_used_nor_moved() -> None:
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = bits(0, KEYS, Stream.METRIC, 0, 10, 2)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    assert torch.equal(bits(0, KEYS, Stream.METRIC, 0, 10, 2), first)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_same_on_the_gpu() -> None:
    for function in (bits, uniform):
        on_cpu = function(9, KEYS, Stream.SAMPLING, 3, 100, 7)
        assert torch.equal(function(9, KEYS.cuda(), Stream.SAMPLING, 3, 100, 7).cpu(), on_cpu)


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, 5, -3, 2**62])
def test_the_same_bits(seed: int, key: int) -> None:
    for stream in Stream:
        for start in (0, 2**33):
            out = np.empty((50, 3))
            uniforms(mixed_seed(seed, stream), key, start, out)
            words = [[reference.number(seed, key, stream, start + i, j, 3) for j in range(3)] for i in range(50)]
            assert out.tolist() == [[(word >> 10) / 2**53 for word in row] for row in words]
            tensors = uniform(seed, torch.tensor([key]), stream, start, 50, 3)[0]
            assert out.tolist() == tensors.tolist()
        order = sorted(range(1000), key=lambda i: reference.number(seed, key, stream, 0, i, 1))
        for most in (1, 17, 1000, 2000):
            index = np.empty(most, np.int64)
            count = shuffle(1000, mixed_seed(seed, stream), key, index)
            assert index[:count].tolist() == order[:most]

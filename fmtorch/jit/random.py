"""Random numbers as a stateless function of (seed, pair key, stream, draw): the same in any batch, on any device.

Kernels have `random_bits` and `uniform_kernel`; tensors have `bits` and `uniform`, the same functions of arrays."""

import enum
import functools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.jit.kernel import inner


class Stream(enum.IntEnum):
    """What a random number is for; streams of the same pair are independent."""

    SAMPLING = 1
    PRESELECTION = 2
    METRIC = 3
    TRAINING = 4
    PLANE = 5
    PARALLAX = 6
    REFINEMENT = 7
    FOCAL = 8
    AUGMENTATION = 9
    BATCHES = 10


@functools.lru_cache(maxsize=64)
def mixed_seed(seed: int, stream: Stream) -> int:
    """The seed and the stream, mixed by splitmix64, as an int64."""
    x = ((seed * 2 + 1) * 0x9E3779B97F4A7C15 + int(stream)) % (1 << 64)
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % (1 << 64)
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB % (1 << 64)
    x ^= x >> 31
    return x - (1 << 64) if x >= 1 << 63 else x


Word = Any  # np.uint64


@inner
def mix(x: Word) -> Word:
    """The finaliser of splitmix64 of a word, uint64."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@inner
def stream_state(mixed_seed: int, key: int) -> Word:
    """What the numbers of a pair's stream are made of, uint64; mixed_seed: of the seed and the stream, int64."""
    return mix(np.uint64(np.int64(key)) ^ np.uint64(np.int64(mixed_seed)))


@inner
def random_bits(state: Word, counter: int) -> Word:
    """Number `counter` (draw * columns + column) of a stream: 63 random bits, uint64."""
    return mix(state + np.uint64(counter) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(1)


@inner
def uniform_kernel(state: Word, counter: int) -> Any:
    """Number `counter` of a stream in [0, 1), with 53 random bits."""
    return np.float64(random_bits(state, counter) >> np.uint64(10)) * 2.0**-53


def bits(
    seed: int, key: Int[Tensor, " b"], stream: Stream, start: int, count: int, columns: int
) -> Int[Tensor, "b count columns"]:
    """Random 63-bit non-negative integers for the draws start .. start + count - 1, `columns` numbers a draw."""
    keys: Any = key.cpu().numpy()[:, None]
    counters: Any = np.arange(start * columns, (start + count) * columns)
    words = random_bits(stream_state(mixed_seed(seed, stream), keys), counters)
    return torch.from_numpy(words.astype(np.int64)).reshape(len(key), count, columns).to(key.device)


def uniform(
    seed: int, key: Int[Tensor, " b"], stream: Stream, start: int, count: int, columns: int
) -> Float[Tensor, "b count columns"]:
    """Random numbers in [0, 1), float64, with 53 random bits; arguments as `bits`."""
    return (bits(seed, key, stream, start, count, columns) >> 10).to(torch.float64).mul_(2.0**-53)

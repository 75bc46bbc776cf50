"""`random`, compiled: the same integer arithmetic, hence the same numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmtorch.compiling.kernel import inner

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
def uniform(state: Word, counter: int) -> Any:
    """Number `counter` of a stream in [0, 1), with 53 random bits."""
    return np.float64(random_bits(state, counter) >> np.uint64(10)) * 2.0**-53

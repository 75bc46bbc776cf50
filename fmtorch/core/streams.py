"""What random numbers are for, and the seed of each purpose: without tensors."""

from __future__ import annotations

import enum
import functools


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


def wrap(value: int) -> int:
    """An unsigned 64-bit constant as the int64 with the same bits."""
    return value - (1 << 64) if value >= 1 << 63 else value


@functools.lru_cache(maxsize=64)
def mixed_seed(seed: int, stream: Stream) -> int:
    """The seed and the stream, mixed by splitmix64, as an int64."""
    x = ((seed * 2 + 1) * 0x9E3779B97F4A7C15 + int(stream)) % (1 << 64)
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % (1 << 64)
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB % (1 << 64)
    return wrap(x ^ (x >> 31))

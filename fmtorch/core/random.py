"""Random numbers as a stateless function of (seed, pair key, stream, draw): the same in any batch and on any device."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.core.streams import Stream, mixed_seed, wrap

_GAMMA, _MIX1, _MIX2 = (wrap(c) for c in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def _shift_right(x: Tensor, n: int) -> Tensor:
    """Logical right shift of int64."""
    return (x >> n).bitwise_and_((1 << (64 - n)) - 1)


def _mix(x: Int[Tensor, "*shape"]) -> Int[Tensor, "*shape"]:
    """The finaliser of splitmix64 (Steele, Lea, Flood, OOPSLA 2014): a bijection of 64-bit words."""
    x = _shift_right(x, 30).bitwise_xor_(x).mul_(_MIX1)
    x = _shift_right(x, 27).bitwise_xor_(x).mul_(_MIX2)
    return _shift_right(x, 31).bitwise_xor_(x)


def bits(
    seed: int, key: Int[Tensor, " b"], stream: Stream, start: int, count: int, columns: int
) -> Int[Tensor, "b count columns"]:
    """Random 63-bit non-negative integers for the draws start .. start + count - 1, `columns` numbers a draw."""
    device = key.device
    counter = torch.arange(start * columns, (start + count) * columns, device=device, dtype=torch.int64)
    state = _mix(key ^ mixed_seed(seed, stream))[:, None] + (counter * _GAMMA)[None]
    return _shift_right(_mix(state), 1).reshape(len(key), count, columns)


def uniform(
    seed: int, key: Int[Tensor, " b"], stream: Stream, start: int, count: int, columns: int
) -> Float[Tensor, "b count columns"]:
    """Random numbers in [0, 1), float64, with 53 random bits; arguments as `bits`."""
    return (bits(seed, key, stream, start, count, columns) >> 10).to(torch.float64).mul_(2.0**-53)

"""Maxima of a scale space: 3 x 3 x 3 neighbourhoods and the quadratic through them (Brown and Lowe, BMVC 2002)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

MOVES = 4  # how often a maximum may move to the neighbour that the quadratic points to
CONVERGED = 0.6  # largest offset from the last sample, in samples; 0.5 and some slack between two samples
CHUNK = 1 << 16  # maxima refined together, which bounds memory

# (level, row, column) of the 27 samples, in the order of the volume's memory; the centre is number 13.
NEIGHBOURS = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
CENTRE = 13


class Peaks(NamedTuple):
    """Refined maxima. image: index (M,). position: (level, y, x) in samples (M, 3) float64. value: response (M,)."""

    image: Int[Tensor, " m"]
    position: Float[Tensor, "m 3"]
    value: Float[Tensor, " m"]


def refined_maxima(volume: Float[Tensor, "b s h w"], seeds: Int[Tensor, "m 4"], threshold: float) -> Peaks:
    """The maxima among `seeds`, samples (b, level, y, x), refined to sub-sample positions and values.

    A seed is a maximum where it exceeds the neighbours before it in memory and no neighbour after it exceeds it, so
    that of equal neighbours one remains. A maximum moves to the sample nearest to the quadratic's; it is dropped where
    it leaves the volume, does not settle, the quadratic has no maximum, or its value is at most `threshold`. Of those
    that end at one sample one remains.
    """
    chunks = [_refine(volume, part) for part in torch.split(seeds, CHUNK)] or [_refine(volume, seeds)]
    at, offset, value = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    kept = value > threshold
    at, offset, value = at[kept], offset[kept], value[kept]
    first = _first_of_each(_linear(volume, at))
    return Peaks(at[first, 0], at[first, 1:].double() + offset[first], value[first])


def _refine(volume: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The samples (K, 4), offsets (K, 3) and values (K,) of the seeds that are maxima and settle."""
    at = at[_exceeds_levels(volume, at)]
    at = at[_is_maximum(_samples(volume, at))]
    last = torch.tensor(volume.shape[1:], device=volume.device) - 2
    offset, value, peaked = _quadratic(_samples(volume, at))
    for _ in range(MOVES):
        moving = torch.nonzero(peaked & (offset.abs() > CONVERGED).any(1))[:, 0]
        moved = at[moving, 1:] + offset[moving].round().clamp(-1, 1).long()
        inside = ((moved >= 1) & (moved <= last)).all(1)
        moving, moved = moving[inside], moved[inside]
        if len(moving) == 0:
            break
        at[moving, 1:] = moved
        offset[moving], value[moving], peaked[moving] = _quadratic(_samples(volume, at[moving]))
    settled = peaked & (offset.abs() <= CONVERGED).all(1)
    return at[settled], offset[settled], value[settled]


def _linear(volume: Tensor, at: Tensor) -> Tensor:
    """Position in memory of the samples (M, 4)."""
    _, s, h, w = volume.shape
    return ((at[:, 0] * s + at[:, 1]) * h + at[:, 2]) * w + at[:, 3]


def _samples(volume: Tensor, at: Tensor) -> Float[Tensor, "27 m"]:
    """The neighbourhoods of inner samples (M, 4)."""
    _, _, h, w = volume.shape
    steps = NEIGHBOURS.to(volume.device) @ torch.tensor([h * w, w, 1], device=volume.device)
    return volume.reshape(-1)[_linear(volume, at) + steps[:, None]]


def _exceeds_levels(volume: Tensor, at: Tensor) -> Tensor:
    """Whether inner samples (M, 4) can be maxima by the samples before and after them: most seeds are not."""
    _, _, h, w = volume.shape
    values, place = volume.reshape(-1), _linear(volume, at)
    centre = values[place]
    return (centre > values[place - h * w]) & (centre >= values[place + h * w])


def _is_maximum(v: Float[Tensor, "27 m"]) -> Tensor:
    return (v[CENTRE] > v[:CENTRE]).all(0) & (v[CENTRE] >= v[CENTRE + 1 :]).all(0)


def _quadratic(v: Float[Tensor, "27 m"]) -> tuple[Tensor, Tensor, Tensor]:
    """Of the quadratic with the central differences of 27 samples: the maximum (M, 3), its value, whether there is one.

    Cramer's rule on the negative Hessian, which is positive definite at a maximum.
    """
    cube = v.double().reshape(3, 3, 3, -1)
    c = cube[1, 1, 1]
    gs, gy, gx = (
        0.5 * (high - low)
        for low, high in (
            (cube[0, 1, 1], cube[2, 1, 1]),
            (cube[1, 0, 1], cube[1, 2, 1]),
            (cube[1, 1, 0], cube[1, 1, 2]),
        )
    )
    ss, yy, xx = (
        2 * c - low - high
        for low, high in (
            (cube[0, 1, 1], cube[2, 1, 1]),
            (cube[1, 0, 1], cube[1, 2, 1]),
            (cube[1, 1, 0], cube[1, 1, 2]),
        )
    )
    sy = -0.25 * (cube[2, 2, 1] - cube[2, 0, 1] - cube[0, 2, 1] + cube[0, 0, 1])
    sx = -0.25 * (cube[2, 1, 2] - cube[2, 1, 0] - cube[0, 1, 2] + cube[0, 1, 0])
    yx = -0.25 * (cube[1, 2, 2] - cube[1, 2, 0] - cube[1, 0, 2] + cube[1, 0, 0])
    minor = ss * yy - sy * sy
    cofactors = (yy * xx - yx * yx, sx * yx - sy * xx, sy * yx - sx * yy)
    determinant = ss * cofactors[0] + sy * cofactors[1] + sx * cofactors[2]
    peaked = (ss > 0) & (minor > 0) & (determinant > 0)
    safe = torch.where(peaked, determinant, 1.0)
    ds = (cofactors[0] * gs + cofactors[1] * gy + cofactors[2] * gx) / safe
    dy = (cofactors[1] * gs + (ss * xx - sx * sx) * gy + (sy * sx - ss * yx) * gx) / safe
    dx = (cofactors[2] * gs + (sy * sx - ss * yx) * gy + minor * gx) / safe
    value = c + 0.5 * (gs * ds + gy * dy + gx * dx)
    return torch.stack([ds, dy, dx], 1), value.to(v.dtype), peaked


def _first_of_each(key: Tensor) -> Tensor:
    """Indices, in order, of the first occurrence of each key."""
    order = torch.argsort(key, stable=True)
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = key[order[1:]] != key[order[:-1]]
    return order[first].sort().values

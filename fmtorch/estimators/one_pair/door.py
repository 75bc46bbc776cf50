"""The door of one pair: its usable matches, normalised, or why it cannot be estimated. As `estimators.pairs`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fmtorch.compiling.batches import as_array
from fmtorch.core.checks import PER_MATCH, reason
from fmtorch.core.types import SIZE, Correspondences
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.pairs import MAX_COORDINATE_PX, MAX_NOISE, MIN_NOISE, bucket, too_few
from fmtorch.estimators.pairs_kernels import normalize

UNKNOWN = np.empty(0)  # the sizes of the images, or what else is not told
BOUNDS = np.array([MAX_COORDINATE_PX, MIN_NOISE, MAX_NOISE])  # as the kernel takes them


class Rows(NamedTuple):
    """The tensors of a batch on the CPU as arrays, one row a pair; sizes: (b, 4), h, w, h, w, empty where unknown."""

    x0: Array
    x1: Array
    mask: Array
    prior: Array | None
    noise: Array | None
    quality: Array | None
    sizes: Array
    keys: list[int]

    @staticmethod
    def of(c: Correspondences) -> Rows:
        """Views where the tensors are of float32 or float64."""
        prior, noise, quality = [None if t is None else _array(t) for t in (c.prior, c.noise, c.quality)]
        keys: list[int] = c.keys.tolist()
        sizes = np.empty((len(keys), 0 if c.size0 is None else 4))
        if c.size0 is not None and c.size1 is not None:
            sizes[:, :2], sizes[:, 2:] = _array(c.size0), _array(c.size1)
        return Rows(_array(c.x0), _array(c.x1), c.mask.numpy(), prior, noise, quality, sizes, keys)


class Arrived(NamedTuple):
    """One pair as it came: matches in pixels (n, 2), float64; mask (n,); image sizes (h, w), empty where unknown."""

    x0: Array
    x1: Array
    mask: Array
    size0: Array
    size1: Array

    @staticmethod
    def of(rows: Rows, i: int) -> Arrived:
        """One row."""
        mask, sizes = np.ascontiguousarray(rows.mask[i]), rows.sizes[i]
        return Arrived(_row(rows.x0, i), _row(rows.x1, i), mask, sizes[:2], sizes[2:])


def opened(rows: Rows, i: int, one: Arrived, seed: int, least: int) -> tuple[OnePair, Array] | str:
    """The pair of a row, and where its matches (n,) stood; or why it cannot be estimated."""
    n, sizes, frame = len(one.mask), rows.sizes[i], np.empty(6)
    slots, flat = np.empty(n, np.int64), np.empty(9 * n)
    told = rows.prior is not None, rows.noise is not None, rows.quality is not None
    prior, noise, quality = _row(rows.prior, i), _row(rows.noise, i), _row(rows.quality, i)
    count = normalize(one.x0, one.x1, one.mask, prior, noise, quality, sizes, BOUNDS, slots, flat, frame)
    slot, table, (unit, right) = slots[:count], flat[: 9 * count].reshape(9, count), frame[4:].tolist()
    if lack := too_few(count, least) or ("" if right else _wrong(rows, i, one, slot)):
        return lack
    if not unit:
        return "all matches coincide"
    return OnePair(table, told, bucket(count), unit, rows.keys[i], seed, frame[:4], sizes), slot


def _wrong(rows: Rows, i: int, one: Arrived, slot: Array) -> str:
    """Why a pair whose matches have such values cannot be estimated."""
    values = {"prior": rows.prior, "noise": rows.noise}
    right = {name: PER_MATCH[name].holds(v[i, slot]) for name, v in values.items() if v is not None}
    right |= {"size0": SIZE.holds(one.size0), "size1": SIZE.holds(one.size1)}
    return reason({name: len(each) - int(np.count_nonzero(each)) for name, each in right.items()})


def _row(values: Array | None, i: int) -> Array:
    return UNKNOWN if values is None else np.ascontiguousarray(values[i], np.float64)


def _array(tensor: Tensor) -> Array:
    known = tensor.dtype in (torch.float32, torch.float64) or not tensor.is_floating_point()
    return as_array(tensor if known else tensor.to(torch.float64))

"""The door of one pair: its usable matches, normalised, or why it cannot be estimated. As `estimators.pairs`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.pairs import MAX_COORDINATE_PX, MAX_NOISE, MIN_NOISE, bucket, too_few
from fmtorch.estimators.pairs_kernels import normalize
from fmtorch.types import Correspondences
from fmtorch.validation import PER_MATCH, reason, right_size

UNKNOWN = np.empty(0)  # the size of an image


class Rows(NamedTuple):
    """The tensors of a batch on the CPU as arrays, one row a pair."""

    x0: Array
    x1: Array
    mask: Array
    quality: Array | None
    prior: Array | None
    noise: Array | None
    size0: Array | None
    size1: Array | None
    keys: list[int]
    right: bool

    @staticmethod
    def of(c: Correspondences) -> Rows:
        """Views where the tensors are of float32 or float64; right: whether no value of a match or size is wrong."""
        told = (c.quality, c.prior, c.noise, c.size0, c.size1)
        quality, prior, noise, size0, size1 = (None if t is None else _array(t) for t in told)
        keys: list[int] = c.keys.tolist()
        x0, x1, mask = _array(c.x0), _array(c.x1), c.mask.numpy()
        values = {"prior": prior, "noise": noise}
        checked = [PER_MATCH[name][0](v) | ~mask for name, v in values.items() if v is not None]
        checked += [right_size(size) for size in (size0, size1) if size is not None]
        right = all(bool(each.all()) for each in checked)
        return Rows(x0, x1, mask, quality, prior, noise, size0, size1, keys, right)


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
        x0, x1 = (np.ascontiguousarray(x[i], np.float64) for x in (rows.x0, rows.x1))
        sizes = (UNKNOWN if size is None else size[i].astype(np.float64) for size in (rows.size0, rows.size1))
        return Arrived(x0, x1, np.ascontiguousarray(rows.mask[i]), *sizes)


def opened(rows: Rows, i: int, one: Arrived, seed: int, least: int) -> tuple[OnePair, Array] | str:
    """The pair of a row, and where its matches (n,) stood; or why it cannot be estimated."""
    n, frame = len(one.mask), np.empty(5)
    slots, flat = np.empty(n, np.int64), np.empty(4 * n)
    count = normalize(one.x0, one.x1, one.mask, MAX_COORDINATE_PX, slots, flat, frame)
    slot, points = slots[:count], flat[: 4 * count].reshape(4, count)
    told = {"quality": rows.quality, "prior": rows.prior, "noise": rows.noise}
    values = {name: None if value is None else value[i, slot] for name, value in told.items()}
    if lack := too_few(count, least) or ("" if rows.right else _wrong(values, one)):
        return lack
    if not frame[4]:
        return "all matches coincide"
    quality, prior, noise = (None if v is None else v.astype(np.float64) for v in values.values())
    if noise is not None:
        noise.clip(MIN_NOISE, MAX_NOISE, out=noise)
    sizes = None if rows.size0 is None else np.concatenate([one.size0, one.size1]).reshape(2, 2)
    unit = float(frame[4])
    pair = OnePair(points, bucket(count), unit, rows.keys[i], seed, quality, prior, noise, frame[:4], sizes)
    return pair, slot


def _wrong(values: dict[str, Array | None], one: Arrived) -> str:
    """Why a pair with these values of its matches cannot be estimated; empty where they are right."""
    right = {name: rule(v) for name, (rule, _) in PER_MATCH.items() if (v := values[name]) is not None}
    right |= {"size0": right_size(one.size0), "size1": right_size(one.size1)}
    return reason({name: len(each) - int(np.count_nonzero(each)) for name, each in right.items()})


def _array(tensor: Tensor) -> Array:
    known = not tensor.is_floating_point() or tensor.dtype in (torch.float32, torch.float64)
    array: Array = (tensor if known else tensor.to(torch.float64)).detach().numpy()
    return array

"""What users hand over, as tensors: NumPy or torch, one pair or a batch, pairs of different lengths as lists."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, collate

Array = Tensor | NDArray[Any]
Arrays = Array | Sequence[Any]
"""One array, or a list of them: of pairs of different lengths."""

PER_MATCH = {name: len(Correspondences.declared[name].shape) - 1 for name in Correspondences.per_slot}
"""The dimensions of what has an entry for each match, of one pair."""


def as_tensor(value: Any, name: str) -> Tensor:
    """A tensor of numbers, of an array without copying. Raises TypeError, naming the argument, for anything else."""
    if isinstance(value, Tensor):
        return value
    if isinstance(value, list | tuple) and value and all(isinstance(entry, Tensor) for entry in value):
        return torch.stack(list(value))
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise TypeError(
            f"{name} is a {type(value).__name__} of uneven rows; it must be an array or a tensor"
        ) from error
    if array.dtype.kind not in "biuf":
        raise TypeError(
            f"{name} is a {type(value).__name__} of {array.dtype}; it must be an array or tensor of numbers"
        )
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        array = array.astype(np.int64)
    array = np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def number(name: str, value: Any, integer: bool) -> Any:
    """A number, not NaN; what has one element may be one. Raises TypeError or ValueError naming the argument."""
    if isinstance(value, bool | np.bool_ | str | bytes | complex | np.complexfloating):
        raise TypeError(f"{name} is {value!r}; it must be a {'whole ' if integer else ''}number")
    if isinstance(value, int | float):
        plain: Any = value
    else:
        try:
            plain = operator.index(value) if integer else float(value)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            said = "whole number" if integer else "number"
            raise TypeError(f"{name} is a {type(value).__name__}; it must be a {said}") from None
    if integer and not isinstance(plain, int):
        raise TypeError(f"{name} is {value!r}; it must be a whole number")
    if math.isnan(plain):
        raise ValueError(f"{name} is nan; it must be a number")
    return value if isinstance(value, int | float) else plain


def correspondences(x0: Arrays, x1: Arrays, **fields: Any) -> Correspondences:
    """The batch that points and what is known of them describe; fields: of `Correspondences`, or None.

    x0, x1: (N, 2) of one pair, (B, N, 2) of a padded batch, or a list of (N, 2) of different N. Per-match fields come
    in the same form. A size is one for all pairs, (2,), or one each, (B, 2), and so is a key. Points in whole numbers
    become float64; x0 decides the device. Raises TypeError for what is no array of numbers, ValueError for wrong
    shapes.
    """
    ragged = [name for name, value in (("x0", x0), ("x1", x1)) if _is_list_of_pairs(value)]
    if len(ragged) == 1:
        raise ValueError(f"{ragged[0]} is a list of pairs and the other is not; both must be, or neither")
    if ragged:
        return _of_list(cast(Sequence[Any], x0), cast(Sequence[Any], x1), fields)
    points0, points1 = _points(x0, "x0"), _points(x1, "x1")
    if points0.shape != points1.shape:
        raise ValueError(f"x0 has shape {tuple(points0.shape)} but x1 {tuple(points1.shape)}; they must be equal")
    if points0.dim() == 3 and points0.shape[1] == 1 and len(points0) > 1 and fields.get("mask") is None:
        raise ValueError(
            f"x0 and x1 have shape {tuple(points0.shape)}, as OpenCV stores {len(points0)} points; give x0[:, 0] and "
            f"x1[:, 0] for one pair (with a mask they are {len(points0)} pairs of one match)"
        )
    single = points0.dim() == 2
    points0, points1 = (points[None] if single else points for points in (points0, points1.to(points0.device)))
    kind = torch.promote_types(points0.dtype, points1.dtype)
    known = {name: _field(name, value, single, points0) for name, value in fields.items() if value is not None}
    mask = known.pop("mask", None)
    mask = torch.ones_like(points0[..., 0], dtype=torch.bool) if mask is None else mask.to(torch.bool)
    return Correspondences(points0.to(kind), points1.to(kind), mask, **known)


def _is_list_of_pairs(value: object) -> bool:
    """Whether the elements are pairs' points, and not single points; of an empty list there are none of either."""
    return isinstance(value, list | tuple) and (not value or getattr(value[0], "ndim", _depth(value[0])) >= 2)


def _depth(value: object) -> int:
    """How deeply lists are nested."""
    if not isinstance(value, list | tuple):
        return 0
    return 1 + (_depth(value[0]) if value else 0)


def _points(value: object, name: str) -> Tensor:
    points = as_tensor(value, name)
    if points.dim() not in (2, 3) or points.shape[-1] != 2:
        raise ValueError(f"{name} has shape {tuple(points.shape)}; it must be (N, 2) or (B, N, 2)")
    return points if points.is_floating_point() else points.to(torch.float64)


def _field(name: str, value: object, single: bool, points: Tensor) -> Tensor:
    """A field of a batch: with the leading dimension where one pair's came without, sizes and keys for each pair."""
    tensor = as_tensor(value, name).to(points.device)
    if name == "key" and tensor.is_floating_point():
        raise ValueError(f"key is of {tensor.dtype}; it must be whole numbers (`pair_key` makes them)")
    tensor = tensor.to(torch.int64) if name == "key" else tensor
    if name in PER_MATCH:
        return tensor[None] if single and tensor.dim() == PER_MATCH[name] else tensor
    shape = tuple(map(int, Correspondences.declared[name].shape[1:]))
    if tuple(tensor.shape) in (shape, (1, *shape)):
        return tensor.expand(len(points), *shape)
    if tuple(tensor.shape) != (len(points), *shape):
        single_shape = f"{shape} for all pairs" if shape else "one number for all pairs"
        raise ValueError(
            f"{name} has shape {tuple(tensor.shape)}; it must be {single_shape}, or {(len(points), *shape)}"
        )
    return tensor


def _of_list(x0: Sequence[Any], x1: Sequence[Any], fields: Mapping[str, Any]) -> Correspondences:
    """A padded batch of pairs of different lengths."""
    count = len(x0)
    for name, value in {"x1": x1, **{name: fields[name] for name in PER_MATCH if fields.get(name) is not None}}.items():
        listed = isinstance(value, list | tuple | Tensor | np.ndarray) and getattr(value, "ndim", 1) > 0
        if not listed or len(cast(Any, value)) != count:
            raise ValueError(f"{name} must be a list of {count} arrays, one for each pair of x0")
    if not count:
        return correspondences(torch.zeros(0, 0, 2), torch.zeros(0, 0, 2))
    batch_fields = {
        name: _field(name, value, False, torch.zeros(count, 0, 2))
        for name, value in fields.items()
        if value is not None and name not in PER_MATCH
    }
    pairs = []
    for i in range(count):
        own = {name: fields[name][i] for name in PER_MATCH if fields.get(name) is not None}
        pairs.append(_one_of_list(i, x0[i], x1[i], {**own, **{name: value[i] for name, value in batch_fields.items()}}))
    device, kind = pairs[0].x0.device, functools.reduce(torch.promote_types, (pair.x0.dtype for pair in pairs))
    return collate(
        [pair.to(device).replace(x0=pair.x0.to(device, kind), x1=pair.x1.to(device, kind)) for pair in pairs]
    )


def _one_of_list(i: int, x0: Any, x1: Any, fields: Mapping[str, Any]) -> Correspondences:
    try:
        points0, points1 = as_tensor(x0, "x0"), as_tensor(x1, "x1")
        if points0.dim() != 2 or points1.dim() != 2:
            raise ValueError(
                f"x0 and x1 have shapes {tuple(points0.shape)} and {tuple(points1.shape)}; both must be (N, 2)"
            )
        return correspondences(points0, points1, **fields)
    except (TypeError, ValueError) as error:
        raise type(error)(f"pair {i}: {error}") from error

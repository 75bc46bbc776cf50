"""What arguments may be, checked where a user's come in: shapes, types of numbers, devices, values.

Annotations are the source: ``Float[Tensor, "*batch n 2"]`` is both what a reader sees and what is asked for.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from fmtorch.core.annotations import WHOLE, Expected, arguments_of, numbers_of
from fmtorch.core.arguments import as_tensor, number
from fmtorch.core.rules import FOCAL, SIZE
from fmtorch.core.types import Correspondences

P = ParamSpec("P")
R = TypeVar("R")

WIDENED = (torch.float16, torch.bfloat16)  # in which no matrix can be decomposed
MODELS, SETS = "models", "batch"  # leading dimensions of F and of the matches it is fitted to: one F a set, or several


def checked(function: Callable[P, R], *, common_type: bool = False) -> Callable[P, R]:
    """The function, which takes NumPy arrays and lists for tensors and names what does not fit its annotations.

    Whole numbers become float64 where the annotation asks for floating-point ones, and half precision is widened to
    float32. Arrays go to the device of the first tensor. Where everything fits, the function gets what it was given.
    common_type: bring floating-point tensors of several types to the widest one.

    Raises (beside what the function itself raises) TypeError for what is no array or number, ValueError for a shape,
    a type of numbers or a device that does not fit; the message begins with the argument's name.
    """
    signature = inspect.signature(function)
    expected = functools.cache(functools.partial(arguments_of, function))

    @functools.wraps(function)
    def door(*args: P.args, **kwargs: P.kwargs) -> R:
        call = signature.bind(*args, **kwargs)
        values = call.arguments
        device = next((value.device for value in values.values() if isinstance(value, Tensor)), torch.device("cpu"))
        tensors = {}
        for name, want in expected().items():
            if name not in values or (values[name] is None and want.optional):
                continue
            values[name] = value = _checked_value(name, values[name], want, device)
            if want.kind == "array":
                tensors[name] = value
        _expect_shapes(tensors, expected())
        if common_type:
            values.update(_common_type(tensors, expected()))
        return function(*call.args, **call.kwargs)

    return door


def check_exported(package: str) -> None:
    """Make the functions that a package exports, those of its `__all__`, `checked` with one type for all tensors.

    The package's own modules import each other's functions unchecked, from where they are defined.
    """
    module = sys.modules[package]
    for name in module.__all__:
        function = getattr(module, name)
        if inspect.isfunction(function):
            door = checked(function, common_type=True)
            door.__module__ = package  # where pickle finds it
            setattr(module, name, door)


def _checked_value(name: str, value: Any, want: Expected, device: torch.device) -> Any:
    """The value as the function takes it. Raises TypeError or ValueError naming the argument."""
    if want.kind in ("int", "float") or (want.kind == "number or array" and not isinstance(value, Tensor | np.ndarray)):
        return number(name, value, want.kind == "int")
    if want.kind in ("numbers", "whole numbers"):
        integer = want.kind == "whole numbers"
        return tuple(number(f"{name}[{i}]", entry, integer) for i, entry in enumerate(_sequence(name, value)))
    if want.kind in ("bool", "str"):
        kind = {"bool": (bool, np.bool_), "str": (str,)}[want.kind]
        if not isinstance(value, kind):
            said = "True or False" if want.kind == "bool" else "a string"
            raise TypeError(f"{name} is a {type(value).__name__}; it must be {said}")
        return value
    if want.kind == "function" and not callable(value):
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a function")
    if want.kind == "choice" and value not in want.choices:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, want.choices))}")
    if not want.dtype:
        return value
    if isinstance(value, Tensor):
        if value.device != device:
            raise ValueError(f"{name} is on {value.device} and another argument on {device}; all must be on one device")
        tensor = value
    else:
        tensor = as_tensor(value, name).to(device)
    return _numbers(name, tensor, want)


def _sequence(name: str, value: Any) -> list[Any]:
    if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__len__") or getattr(value, "ndim", 1) != 1:
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a sequence of numbers")
    return list(value)


def _numbers(name: str, tensor: Tensor, want: Expected) -> Tensor:
    """The tensor, with elements of the kind asked for. Raises ValueError naming the argument for others."""
    integer = numbers_of(tensor.dtype) == WHOLE and not tensor.is_quantized
    if want.dtype == "Float" and integer:
        return tensor.to(torch.float64)
    if want.dtype == "Bool" and integer:
        return tensor != 0
    if tensor.dtype in WIDENED and want.dtype in ("Float", "Real"):
        return tensor.to(torch.float32)
    if tensor.is_quantized or not want.holds(tensor.dtype):
        raise ValueError(f"{name} is of {tensor.dtype}; it must hold {want.numbers}")
    return tensor


def _expect_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Expected]) -> None:
    """Raises ValueError naming the first tensor whose shape does not fit its annotation or those before it."""
    sizes: dict[str, tuple[int, str]] = {}  # what a dimension's name stands for, and whose shape said so
    leading: dict[str, tuple[tuple[int, ...], str]] = {}  # the same of leading dimensions
    for name, tensor in tensors.items():
        shape, want = tuple(tensor.shape), expected[name].shape
        variadic = want[0] if want and want[0].startswith("*") else None
        trailing = want[1:] if variadic else want
        extra = len(shape) - len(trailing)
        if extra < 0 or (extra and variadic is None):
            raise ValueError(f"{name} has shape {shape}; it must be {_readable(want)}")
        for size, token in zip(shape[extra:], trailing, strict=True):
            known, whose = (int(token), "") if token.isdigit() else sizes.setdefault(token, (size, name))
            if size != known:
                where = f" with {token} = {known}, as of {whose}" if whose else ""
                raise ValueError(f"{name} has shape {shape}; it must be {_readable(want)}{where}")
        if variadic is not None:
            _expect_leading(name, shape, extra, variadic, leading)
    if MODELS in leading and SETS in leading:
        (models, name), (sets, whose) = leading[MODELS], leading[SETS]
        if models != sets and models[:-1] != sets:
            raise ValueError(
                f"{name} has leading dimensions {models}; they must be {sets}, as of {whose}, or {sets} and one more"
            )


def _expect_leading(
    name: str, shape: tuple[int, ...], extra: int, variadic: str, leading: dict[str, tuple[tuple[int, ...], str]]
) -> None:
    """Leading dimensions equal to those of the same name before, or broadcast with them where a # says so."""
    group, mine = variadic.lstrip("*#"), shape[:extra]
    known, whose = leading.setdefault(group, (mine, name))
    if mine == known:
        return
    if "#" not in variadic:
        raise ValueError(f"{name} has shape {shape}; its leading dimensions must be {known}, as of {whose}")
    try:
        leading[group] = tuple(torch.broadcast_shapes(known, mine)), whose  # type: ignore[no-untyped-call]
    except RuntimeError:
        raise ValueError(
            f"{name} has shape {shape}; its leading dimensions must broadcast with {known}, as of {whose}"
        ) from None


def _common_type(tensors: Mapping[str, Tensor], expected: Mapping[str, Expected]) -> dict[str, Tensor]:
    """Those floating-point tensors that are not of the widest type among them, in that type."""
    floats = {name: tensor for name, tensor in tensors.items() if expected[name].dtype == "Float"}
    kinds = {tensor.dtype for tensor in floats.values()}
    if len(kinds) < 2:
        return {}
    widest = functools.reduce(torch.promote_types, kinds)
    return {name: tensor.to(widest) for name, tensor in floats.items()}


def _readable(shape: tuple[str, ...]) -> str:
    """``(..., N, 2)`` of jaxtyping's ``*#batch n 2``."""
    tokens = ["..." if token.startswith("*") else token.lstrip("#").upper() for token in shape]
    return f"({', '.join(tokens)}{',' if len(tokens) == 1 else ''})"


PER_MATCH = {name: rule for name in Correspondences.per_slot if (rule := Correspondences.declared[name].bounds)}
RULES = {**PER_MATCH, "size0": SIZE, "size1": SIZE, "focal": FOCAL}
"""The rules for values, in a tensor or an array. NaN is never right."""


def wrong_values(c: Correspondences, mask: Bool[Tensor, "b n"]) -> dict[str, Int[Tensor, " b"]]:
    """How many values of each argument are wrong, in each pair; in slots other than `mask` nothing is."""
    wrong = {}
    for name, rule in RULES.items():
        if (value := getattr(c, name)) is not None:
            broken = ~rule.holds(value.detach())
            wrong[name] = (mask & broken if name in PER_MATCH else broken).sum(1)
    return wrong


def reason(wrong: dict[str, int]) -> str:
    """What is said of a pair with so many wrong values of each argument; empty where there is none."""
    for name, count in wrong.items():
        if count:
            matches = f" of {count} match{'' if count == 1 else 'es'}" if name in PER_MATCH else ""
            return f"{name}{matches} is wrong: {RULES[name].text}"
    return ""


def expect_values(c: Correspondences) -> None:
    """Raises ValueError naming the first wrong value of the real matches of a batch; a GPU is asked but once."""
    wrong = wrong_values(c, c.mask)
    if not wrong or not bool(torch.stack(list(wrong.values())).any()):
        return
    for name, rule in PER_MATCH.items():
        if name in wrong and bool(wrong[name].any()):
            pair, match = (c.mask & ~rule.holds(getattr(c, name))).nonzero()[0].tolist()
            value = getattr(c, name)[pair, match].item()
            raise ValueError(f"{name} of match {match} of pair {pair} is {value}; {rule.text}")
    expect_sizes(size0=c.size0, size1=c.size1)
    if c.focal is not None and not bool(FOCAL.holds(c.focal).all()):
        pair, image = (~FOCAL.holds(c.focal)).nonzero()[0].tolist()
        raise ValueError(f"focal of image {image} of pair {pair} is {c.focal[pair, image].tolist()}; {FOCAL.text}")


def expect_sizes(**sizes: Tensor | None) -> None:
    """Raises ValueError naming the argument and the first size that is not positive and finite."""
    given = {name: size for name, size in sizes.items() if size is not None}
    if all(bool(SIZE.holds(size).all()) for size in given.values()):
        return
    for name, size in given.items():
        rows = size.detach().reshape(-1, size.shape[-1])
        for row in rows[~SIZE.holds(rows).all(-1)].tolist():
            raise ValueError(f"{name} is {tuple(row)}; {SIZE.text}")

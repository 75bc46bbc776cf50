"""What a public function says of its arguments, checked where it is called: shapes, types of numbers, devices.

The annotations are the source: ``Float[Tensor, "*batch n 2"]`` is both what a reader sees and what is asked for.
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch
from jaxtyping import AbstractArray
from torch import Tensor

from fmtorch.core.arguments import as_tensor, number

P = ParamSpec("P")
R = TypeVar("R")

NUMBERS = {"Float": "floating-point numbers", "Int": "whole numbers", "Bool": "booleans", "Real": "real numbers"}
WIDENED = (torch.float16, torch.bfloat16)  # in which no matrix can be decomposed
MODELS, SETS = "models", "batch"  # leading dimensions of F and of the matches it is fitted to: one F a set, or several


class Expected(NamedTuple):
    """What an annotation asks for."""

    kind: str  # of tensors a key of NUMBERS; "int", "float", "bool", "str", "numbers", ...; "" for anything
    shape: tuple[str, ...] = ()  # of a tensor, as jaxtyping writes it: "*#batch", "n", "2"
    optional: bool = False
    choices: tuple[Any, ...] = ()  # of which the value must be one
    number: bool = False  # whether a number will do in place of a tensor


def checked(function: Callable[P, R], *, common_type: bool = False) -> Callable[P, R]:
    """The function, which takes NumPy arrays and lists for tensors and names what does not fit its annotations.

    Whole numbers become float64 where the annotation asks for floating-point ones, and half precision is widened to
    float32. Arrays go to the device of the first tensor. Where everything fits, the function gets what it was given.
    common_type: bring floating-point tensors of several types to the widest one.

    Raises (beside what the function itself raises) TypeError for what is no array or number, ValueError for a shape,
    a type of numbers or a device that does not fit; the message begins with the argument's name.
    """
    signature = inspect.signature(function)

    @functools.cache
    def expected() -> dict[str, Expected]:
        hints = typing.get_type_hints(function)
        return {name: expectation(hints.get(name, Any)) for name in signature.parameters}

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
            if isinstance(value, Tensor) and want.kind in NUMBERS and not want.number:
                tensors[name] = value
        _expect_shapes(tensors, expected())
        if common_type:
            values.update(_common_type(tensors, expected()))
        return function(*call.args, **call.kwargs)

    return door


def public(package: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`checked` with one type for all tensors, for the functions that a package exports.

    The package's own modules import each other's functions unchecked, from where they are defined.
    """

    def export(function: Callable[P, R]) -> Callable[P, R]:
        door = checked(function, common_type=True)
        door.__module__ = package  # where pickle finds it
        return door

    return export


def expectation(hint: Any) -> Expected:
    """What a resolved annotation asks for."""
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, type(int | None)) else (hint,)
    optional = type(None) in options
    options = tuple(option for option in options if option is not type(None))
    arrays = [option for option in options if isinstance(option, type) and issubclass(option, AbstractArray)]
    if arrays:
        kind = arrays[0].__name__.partition("[")[0]
        return Expected(kind, tuple(str(arrays[0].dim_str).split()), optional)
    if set(options) == {float, Tensor}:
        return Expected("Float", ("...",), optional, number=True)
    if len(options) == 1 and typing.get_origin(options[0]) is Sequence:
        whole = typing.get_args(options[0]) == (int,)
        return Expected("whole numbers" if whole else "numbers", (), optional)
    if len(options) == 1 and typing.get_origin(options[0]) is typing.Literal:
        return Expected("choice", (), optional, typing.get_args(options[0]))
    if len(options) == 1 and typing.get_origin(options[0]) is Callable:
        return Expected("function", (), optional)
    if len(options) == 1 and options[0] in (int, float, bool, str):
        return Expected(options[0].__name__, (), optional)
    return Expected("", (), optional)


def _checked_value(name: str, value: Any, want: Expected, device: torch.device) -> Any:
    """The value as the function takes it. Raises TypeError or ValueError naming the argument."""
    if want.kind in ("int", "float") or (want.number and not isinstance(value, Tensor | np.ndarray)):
        return number(name, value, want.kind == "int")
    if want.kind in ("numbers", "whole numbers"):
        whole = want.kind == "whole numbers"
        return tuple(number(f"{name}[{i}]", entry, whole) for i, entry in enumerate(_sequence(name, value)))
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
    if want.kind not in NUMBERS:
        return value
    if isinstance(value, Tensor):
        if value.device != device:
            raise ValueError(f"{name} is on {value.device} and another argument on {device}; all must be on one device")
        tensor = value
    else:
        tensor = as_tensor(value, name).to(device)
    return _numbers(name, tensor, want.kind)


def _sequence(name: str, value: Any) -> list[Any]:
    if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__len__") or getattr(value, "ndim", 1) != 1:
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a sequence of numbers")
    return list(value)


def _numbers(name: str, tensor: Tensor, kind: str) -> Tensor:
    """The tensor, with elements of the kind asked for. Raises ValueError naming the argument for others."""
    floating, boolean = tensor.is_floating_point(), tensor.dtype == torch.bool
    whole = not floating and not boolean and not tensor.is_complex() and not tensor.is_quantized
    if kind == "Float" and whole:
        return tensor.to(torch.float64)
    if kind == "Bool" and whole:
        return tensor != 0
    if tensor.dtype in WIDENED and kind in ("Float", "Real"):
        return tensor.to(torch.float32)
    if not {"Float": floating, "Int": whole, "Bool": boolean, "Real": floating or whole}[kind]:
        raise ValueError(f"{name} is of {tensor.dtype}; it must hold {NUMBERS[kind]}")
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
    floats = {name: tensor for name, tensor in tensors.items() if expected[name].kind == "Float"}
    kinds = {tensor.dtype for tensor in floats.values()}
    if len(kinds) < 2:
        return {}
    widest = functools.reduce(torch.promote_types, kinds)
    return {name: tensor.to(widest) for name, tensor in floats.items()}


def _readable(shape: tuple[str, ...]) -> str:
    """``(..., N, 2)`` of jaxtyping's ``*#batch n 2``."""
    tokens = ["..." if token.startswith("*") else token.lstrip("#").upper() for token in shape]
    return f"({', '.join(tokens)}{',' if len(tokens) == 1 else ''})"

"""What an annotation asks for: the one place that reads annotations, and the only one that knows jaxtyping's.

``Float[Tensor, "*batch n 2"]`` is what a reader sees of a function's argument or a record's field, and what is checked.
"""

import inspect
import typing
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import AbstractArray
from torch import Tensor

from fmtorch.core.options import UNIONS

FLOATING, WHOLE, REAL, BOOLEAN = "floating-point numbers", "whole numbers", "real numbers", "booleans"
NUMBERS = {"Float": FLOATING, "Int": WHOLE, "Int8": WHOLE, "Real": REAL, "Bool": BOOLEAN}


class Rule(NamedTuple):
    """A rule for values: ``Annotated[Float[Tensor, "b n"], Rule(...)]``."""

    holds: Callable[[Any], Any]  # of an array or a tensor, entry by entry
    text: str  # what is said of values for which it does not


class Expected(NamedTuple):
    """What an annotation asks for."""

    kind: str  # "array", "number or array", "int", "float", "bool", "str", "numbers", "choice", ...; "" for anything
    shape: tuple[str, ...] = ()  # of an array, as jaxtyping writes it: "*#batch", "n", "2"
    dtype: str = ""  # of an array, a key of NUMBERS
    bounds: Rule | None = None
    choices: tuple[Any, ...] = ()  # of which the value must be one
    optional: bool = False

    @property
    def numbers(self) -> str:
        """What an array must hold, in words."""
        return NUMBERS[self.dtype]

    def holds(self, dtype: torch.dtype) -> bool:
        """Whether an array of this type holds that."""
        numbers = numbers_of(dtype)
        return numbers == self.numbers or (self.numbers == REAL and numbers in (FLOATING, WHOLE))


def expectation(hint: Any) -> Expected:
    """What a resolved annotation asks for."""
    alternatives = typing.get_args(hint) if typing.get_origin(hint) in UNIONS else (hint,)
    kinds = [alternative for alternative in alternatives if alternative is not type(None)]
    each = [_of_one(kind) for kind in kinds]
    expected = next((entry for entry in each if entry.kind == "array"), each[0] if len(each) == 1 else Expected(""))
    if set(kinds) == {float, Tensor}:
        expected = Expected("number or array", dtype="Float")
    return expected._replace(optional=len(kinds) < len(alternatives))


def _of_one(hint: Any) -> Expected:
    """The same of an annotation that is no union."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        rules = [rule for rule in arguments[1:] if isinstance(rule, Rule)]
        return _of_one(arguments[0])._replace(bounds=rules[0] if rules else None)
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return Expected("array", tuple(str(hint.dim_str).split()), hint.__name__.partition("[")[0])
    if origin is Sequence:
        return Expected("whole numbers" if arguments == (int,) else "numbers")
    if origin is typing.Literal:
        return Expected("choice", choices=arguments)
    if origin is Callable:
        return Expected("function")
    return Expected(hint.__name__ if hint in (int, float, bool, str) else "")


def arguments_of(function: Callable[..., Any]) -> dict[str, Expected]:
    """What a function's annotations say of its parameters, by name."""
    hints = typing.get_type_hints(function, include_extras=True)
    return {name: expectation(hints.get(name, Any)) for name in inspect.signature(function).parameters}


def arrays_of(kind: type) -> dict[str, Expected]:
    """What the annotations of a class say of its arrays, by field."""
    fields = {name: expectation(hint) for name, hint in typing.get_type_hints(kind, include_extras=True).items()}
    return {name: expected for name, expected in fields.items() if expected.kind == "array"}


def numbers_of(dtype: torch.dtype) -> str:
    """What a tensor's elements are, in words."""
    words = FLOATING if dtype.is_floating_point else "complex numbers" if dtype.is_complex else WHOLE
    return BOOLEAN if dtype == torch.bool else words

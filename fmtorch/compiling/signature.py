"""The signature of a kernel, from its annotations: arrays of `arrays`, int, float, bool, and groups of these."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np

NUMBERS = {int: "int64", float: "float64", bool: "boolean", np.float32: "float32"}  # numba's names


def signature_of(function: Callable[..., Any]) -> tuple[Any, ...]:
    """The types of a function's arguments, as numba compiles for them.

    A group is a NamedTuple of such types. Raises TypeError, naming the argument, for a type that is none of these.
    """
    hints = get_type_hints(function, include_extras=True)
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    return tuple(_type(hints.get(name), f"{function.__qualname__}: {name}") for name in names)


def described(kinds: Iterable[Any]) -> str:
    """Types of arguments in words: of groups also where the class is and how its members are called."""
    return ", ".join(f"{_group(kind)}({described(kind)})" if hasattr(kind, "fields") else str(kind) for kind in kinds)


def _group(kind: Any) -> str:
    of = kind.instance_class
    return f"{of.__module__}.{of.__qualname__} {' '.join(kind.fields)}"


def _type(hint: Any, what: str) -> Any:
    from numba import types
    from numba.core import sigutils

    if hint in NUMBERS:
        return getattr(types, NUMBERS[hint])
    if get_origin(hint) is Annotated:
        ((array,), _) = sigutils.normalize_signature(f"({get_args(hint)[1]},)")
        return array
    if hasattr(hint, "_fields"):
        fields = get_type_hints(hint, include_extras=True)
        members = [_type(fields[name], f"{what}.{name}") for name in hint._fields]
        return types.BaseTuple.from_types(members, hint)  # where all are alike, a type of its own
    raise TypeError(f"{what} is annotated {hint}; it must be a type of `compiling.arrays`, a number or a NamedTuple")

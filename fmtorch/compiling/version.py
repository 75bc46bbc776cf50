"""What a compiled function was made of, as one digest: equal versions are equal machine code on the same machine.

A version is taken from live functions, not from files: bytecode, constants, defaults, and every value that the bytecode
takes from its module or its closure. An inner function among them is compiled into the one that calls it, so its own
bytecode and values count as well; of a kernel, which is called through its address, only name and signature do.
Comments, docstrings, line numbers, and what no kernel reaches count for nothing.
"""

from __future__ import annotations

import dis
import enum
import functools
import hashlib
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np

Function = Callable[..., Any]
FOREIGN = {*sys.stdlib_module_names, "builtins", "numpy"}  # packages whose functions and types count by name alone


def version(function: Function, *also: str) -> str:
    """The version of a function as hexadecimal digits. also: what decides its machine code besides.

    Raises TypeError where it takes a value of which no version can be told.
    """
    reached, parts = [function], []
    for each in reached:  # which grows while it is read
        own, inner = _own(each)
        reached += [other for other in inner if other not in reached]
        parts.append((own, [reached.index(other) for other in inner]))
    return hashlib.blake2b(repr((also, parts)).encode(), digest_size=16).hexdigest()


@functools.cache
def _own(function: Function) -> tuple[bytes, list[Function]]:
    """The digest of what one function is made of but for the inner functions that it uses; these."""
    untyped: Any = function
    code, cells, reached = untyped.__code__, untyped.__closure__ or (), list[Function]()

    def described(name: str, value: Any) -> Any:
        if isinstance(value, types.ModuleType) and value.__name__.partition(".")[0] not in FOREIGN:
            used = [each for each in _names(code) if each in vars(value)]
            return name, [described(f"{name}.{each}", vars(value)[each]) for each in used]
        try:
            return name, _value(value, reached)
        except TypeError as error:
            raise TypeError(f"{function.__module__}.{function.__qualname__} uses {name}: {error}") from None

    parts = [
        _code(code, untyped.__doc__),
        described("its defaults", (untyped.__defaults__, untyped.__kwdefaults__)),
        *[described(name, cell.cell_contents) for name, cell in zip(code.co_freevars, cells, strict=True)],
        *[described(name, untyped.__globals__[name]) for name in _global_names(code) if name in untyped.__globals__],
    ]
    return hashlib.blake2b(repr(parts).encode(), digest_size=16).digest(), reached


def _code(code: types.CodeType, docstring: str | None = None) -> tuple[Any, ...]:
    constants = [
        _code(each) if isinstance(each, types.CodeType) else _value(each, [])
        for place, each in enumerate(code.co_consts)
        if place > 0 or docstring is None or each != docstring
    ]
    arguments = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_exceptiontable, arguments


def _names(code: types.CodeType) -> list[str]:
    """All names in code, attributes among them, and in the code within it."""
    return [
        *code.co_names,
        *(name for each in code.co_consts if isinstance(each, types.CodeType) for name in _names(each)),
    ]


def _global_names(code: types.CodeType) -> list[str]:
    """The names that code, and the code within it, takes from its module; in order, each once."""
    operations, arguments = code.co_code[::2], code.co_code[1::2]
    places, place = [], operations.find(_LOAD_GLOBAL)
    while place >= 0:
        high = arguments[place - 1] << 8 if place and operations[place - 1] == _EXTENDED_ARG else 0
        places.append((high | arguments[place]) >> 1)  # the lowest bit says whether it is called
        place = operations.find(_LOAD_GLOBAL, place + 1)
    names = [code.co_names[place] for place in places]
    for each in code.co_consts:
        if isinstance(each, types.CodeType):
            names += _global_names(each)
    return list(dict.fromkeys(names))


_LOAD_GLOBAL, _EXTENDED_ARG = dis.opmap["LOAD_GLOBAL"], dis.opmap["EXTENDED_ARG"]


def _value(value: Any, reached: list[Function]) -> Any:
    """A value as something whose `repr` is the same in every process, and another for another value."""
    if hasattr(type(value), "described"):  # a kernel, an inner function, a function of lanes
        what, function = value.described()
        return what, None if function is None else _place(function, reached)
    if isinstance(value, enum.Enum):
        return _name(type(value)), value.name, _value(value.value, reached)
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, types.EllipsisType, slice)):
        return type(value).__name__, repr(value)
    if isinstance(value, (tuple, list)):
        return _name(type(value)), [_value(each, reached) for each in value]
    if isinstance(value, (dict, frozenset, set)):
        items = value.items() if isinstance(value, dict) else value
        return _name(type(value)), sorted(repr(_value(each, reached)) for each in items)
    if isinstance(value, (np.ndarray, np.generic)):
        return "array", value.dtype.str, value.shape, value.strides, value.tobytes()
    if isinstance(value, np.dtype):
        return "dtype", value.str
    if isinstance(value, enum.EnumMeta):
        members: list[enum.Enum] = list(value)
        return _name(value), [(each.name, _value(each.value, reached)) for each in members]
    if isinstance(value, type):
        fields = [(name, _value(default, reached)) for name, default in getattr(value, "_field_defaults", {}).items()]
        return _name(value), getattr(value, "_fields", None), fields
    return _reference(value, reached)


def _reference(value: Any, reached: list[Function]) -> Any:
    """A module of Python or NumPy, or a function that is none of ours."""
    if hasattr(value, "py_func"):  # compiled by numba without the help of this package
        return "compiled", _place(value.py_func, reached)
    if isinstance(value, types.ModuleType):
        return value.__name__
    module = str(getattr(value, "__module__", None))
    if isinstance(value, np.ufunc) or (callable(value) and module.partition(".")[0] in FOREIGN):
        return _name(value)
    raise TypeError(f"{value!r} has no version: it is neither a number, an array, an inner function nor a kernel")


def named_by_version(function: Function, version: str) -> Function:
    """The same function by a name that no other one has: numba names machine code by functions' names alone.

    Two functions that one function made have one name. Machine code of both, kept by two processes, would be taken for
    the same by a third.
    """
    untyped: Any = function
    name = f"{untyped.__qualname__}_{version[:16]}"
    named = types.FunctionType(
        untyped.__code__, untyped.__globals__, untyped.__name__, untyped.__defaults__, untyped.__closure__
    )
    named.__kwdefaults__, named.__module__, named.__qualname__ = untyped.__kwdefaults__, untyped.__module__, name
    return named


def _place(function: Function, reached: list[Function]) -> int:
    if function not in reached:
        reached.append(function)
    return reached.index(function)


def _name(value: Any) -> str:
    name = getattr(value, "__qualname__", None) or value.__name__
    return f"{getattr(value, '__module__', None) or ''}.{name}"

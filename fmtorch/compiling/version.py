"""What a kernel is made of: the version by which its compiled code is kept.

Taken from the live function, not from a file: its bytecode and constants, the same of every inner function that it
reaches, the signature of every kernel that it calls, and the value of every other constant. So an edited docstring, or
another function of the same file, compiles nothing anew, and kernels may stand anywhere, in a user's own package too.
"""

from __future__ import annotations

import hashlib
import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


def version_of(function: Callable[..., Any], signature: Any) -> str:
    """The digest of all that decides the compiled code of a kernel: 16 hexadecimal digits."""
    parts = [str(signature), *_described(function, set())]
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=8).hexdigest()


def _described(function: Callable[..., Any], seen: set[int]) -> Iterator[str]:
    """The code of a function and the values of the names in it; of each function once, so that circles end."""
    if id(function) in seen:
        return
    seen.add(id(function))
    cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
    names = {name: cell.cell_contents for name, cell in cells.items()}
    yield from _code(function.__code__)
    yield repr(function.__defaults__)
    for name in sorted(_globals(function.__code__)):
        if name in function.__globals__:
            names.setdefault(name, function.__globals__[name])
    for name, value in sorted(names.items()):
        yield f"{name}:"
        yield from _value(value, seen)


def _code(code: types.CodeType) -> Iterator[str]:
    """Instructions and constants, but for the docstring and the places in the file."""
    yield f"{code.co_code.hex()} {code.co_varnames} {code.co_names} {code.co_argcount} {code.co_flags}"
    documented = code.co_consts[:1] if code.co_consts and isinstance(code.co_consts[0], str) else ()
    for constant in code.co_consts[len(documented) :]:
        if isinstance(constant, types.CodeType):
            yield from _code(constant)
        elif isinstance(constant, frozenset):
            yield repr(sorted(map(repr, constant)))
        else:
            yield repr(constant)


def _globals(code: types.CodeType) -> set[str]:
    """The names in code that may be of its module, in functions within it, too."""
    return set(code.co_names).union(*(_globals(c) for c in code.co_consts if isinstance(c, types.CodeType)))


def _value(value: Any, seen: set[int]) -> Iterator[str]:
    """What a name stands for: a kernel by its signature, an inner function by its code, an array by its bytes."""
    if hasattr(value, "compiled_alone"):
        yield f"kernel {value.__module__}.{value.__qualname__} {value.signature}"
    elif hasattr(value, "inline"):
        yield f"inner {value.inline} {getattr(value, 'parameters', ())}"
        yield from _described(value.function, seen)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape} {hashlib.blake2b(value.tobytes()).hexdigest()}"
    elif isinstance(value, type):
        fields = getattr(value, "_fields", ())
        yield f"{value.__module__}.{value.__qualname__} {fields}"
    elif isinstance(value, types.ModuleType):
        yield value.__name__
    elif isinstance(value, types.FunctionType | types.BuiltinFunctionType):
        yield f"{value.__module__}.{value.__qualname__}"
    else:
        yield f"{type(value).__name__} {value!r}"

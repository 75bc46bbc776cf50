"""Functions that numba compiles for this machine when they are first called, kept in a cache folder of their own.

A kernel loops over NumPy arrays where a tensor form would take many small operations::

    @kernel
    def row_sums(x: F4x2, scale: float, out: F4x1) -> None: ...

It is compiled for the types of its annotations: ``F4x2`` is an array of float32 with two axes in C order. Kernels stand
beside the class that calls them; what they are made of versions the file that keeps them (`fmtorch.jit.cache`). Nothing
is imported from numba before the first call. With ``FMTORCH_KERNELS=off`` estimators run their kernels interpreted by
Python, all else takes its tensor form."""

import contextlib
import functools
import gc
import importlib.metadata
import inspect
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, ParamSpec, TypeVar, get_args, get_origin, get_type_hints, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.jit import cache, linking
from fmtorch.jobs.execution import available, cores, mapped

Array = NDArray[Any]
F8x1 = Annotated[NDArray[np.float64], "f8[::1]"]
F8x2 = Annotated[NDArray[np.float64], "f8[:, ::1]"]
F8x3 = Annotated[NDArray[np.float64], "f8[:, :, ::1]"]
F8x4 = Annotated[NDArray[np.float64], "f8[:, :, :, ::1]"]
F4x1 = Annotated[NDArray[np.float32], "f4[::1]"]
F4x2 = Annotated[NDArray[np.float32], "f4[:, ::1]"]
F4x3 = Annotated[NDArray[np.float32], "f4[:, :, ::1]"]
I1x2 = Annotated[NDArray[np.int8], "i1[:, ::1]"]
I8x1 = Annotated[NDArray[np.int64], "i8[::1]"]
I8x2 = Annotated[NDArray[np.int64], "i8[:, ::1]"]
I4x1 = Annotated[NDArray[np.int32], "i4[::1]"]
I4x2 = Annotated[NDArray[np.int32], "i4[:, ::1]"]
U1x1 = Annotated[NDArray[np.uint8], "u1[::1]"]
B1x1 = Annotated[NDArray[np.bool_], "b1[::1]"]
B1x2 = Annotated[NDArray[np.bool_], "b1[:, ::1]"]

NUMBERS = {int: "int64", float: "float64", bool: "boolean", np.float32: "float32"}  # numba's names


def signature_of(function: Callable[..., Any]) -> tuple[Any, ...]:
    """The types of a function's arguments, as numba compiles for them, from its annotations.
    They are array types of this file, numbers, bool, and groups: NamedTuples of such types. Raises TypeError, naming
    the argument, for a type that is none of these."""
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
    wanted = "an array type of `fmtorch.jit.kernel`, a number or a NamedTuple"
    raise TypeError(f"{what} is annotated {hint}; it must be {wanted}")


SWITCH = "FMTORCH_KERNELS"


def off() -> bool:
    """Whether kernels are switched off. Raises ValueError if $FMTORCH_KERNELS is neither on nor off."""
    switch = os.environ.get(SWITCH, "")
    if switch not in ("", "on", "off"):
        raise ValueError(f"{SWITCH}={switch}; it must be on or off")
    return switch == "off"


def identity() -> str:
    """What a run says of its kernels: ``numba 0.68.1``, or ``off``."""
    return "off" if off() else f"numba {importlib.metadata.version('numba')}"


_CLEAR = "\r\x1b[K"
_state = {"announced": False}


def begun(name: str, where: str, count: str = "") -> None:
    """Say that a kernel is compiled, on the error stream: a terminal shows which one, a log gets the first line alone.
    where: it is kept. count: which one of how many it is."""
    if sys.stderr.isatty():
        print(f"{_CLEAR}{count}compiling {name} {where}", end="", file=sys.stderr, flush=True)
    elif not _state["announced"]:
        print(f"{count}compiling {name} and what else is missing {where}", file=sys.stderr, flush=True)
    _state["announced"] = True


P = ParamSpec("P")
R = TypeVar("R")

OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": False, "no_cfunc_wrapper": True}
_lock = threading.RLock()  # numba compiles one function at a time; a kernel may compile those that it calls


class Kernel(Generic[P, R]):
    """A function of NumPy arrays and numbers, compiled for one signature when it is first called. The signature is that
    of its annotations. Arrays of another dtype, number of axes or memory order are refused with a TypeError, never
    converted, and so are numbers in a group; other numbers are converted. Kernels and inner functions may call it, too.
    It holds no Python lock while it runs, unless it is made with holds_gil=True. With FMTORCH_KERNELS=off, for a
    debugger, the plain function runs, a thousand times slower. Raises ImportError where numba cannot be imported."""

    __slots__ = ("__call__", "__dict__")  # so that to call a kernel is to call what is compiled, with nothing between
    __call__: Callable[P, R]

    def __init__(self, function: Callable[P, R], holds_gil: bool = False, always_compiled: bool = False) -> None:
        self.function: Callable[P, R] = inspect.unwrap(function)  # without the checks that tests wrap around functions
        functools.update_wrapper(self, self.function)
        self.holds_gil, self.always_compiled = holds_gil, always_compiled
        self._compiled: Callable[P, R] | None = None
        self.calls: list[Kernel[..., Any]] = []  # those that it calls, once it is compiled
        linking.register(self)
        self.__call__ = self._first_call

    @functools.cached_property
    def signature(self) -> Any:
        """The types of its arguments."""
        return signature_of(self.function)

    @functools.cached_property
    def version(self) -> str:
        """What it is made of, in hexadecimal digits (`fmtorch.jit.cache`)."""
        return cache.version(self.function, described(self.signature), f"holds_gil={self.holds_gil}")

    def described(self) -> tuple[str, None]:
        """Its name and types, all that a kernel that calls it depends on."""
        module, name = self.function.__module__, self.function.__qualname__
        return f"kernel {module}.{name}({described(self.signature)}) -> {linking.returned(self.function)}", None

    def _first_call(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if off() and not self.always_compiled:
            with np.errstate(all="ignore"):  # as compiled: numbers wrap round, and may become infinite or NaN
                return self.function(*args, **kwargs)
        return self.compiled()(*args, **kwargs)

    def compiled(self) -> Callable[P, R]:
        """The compiled function, ready to be called: of this process, of the cache folder, or compiled now.
        Raises ImportError where numba cannot be imported."""
        with _lock:
            if not self.ready:
                function = self.compiled_alone()
                for each in self.calls:
                    each.compiled()
                self.__call__ = function
        return self.__call__

    def compiled_alone(self, count: str = "") -> Callable[P, R]:
        """The compiled function, not to be called before those that it calls are compiled, too.
        A message says that it is compiled now; count: what that begins with. Raises ImportError without numba."""
        with _lock:
            if self._compiled is None:
                self._compiled, self.calls = _compiled(self, count)
        return self._compiled

    @property
    def ready(self) -> bool:
        """Whether this process has compiled it and those that it calls."""
        return self._compiled is not None and self.__call__ is self._compiled

    @property
    def kept(self) -> bool:
        """Whether the cache folder holds it. Raises ImportError where numba cannot be imported."""
        path = cache.path(self.function, self.version)
        return path is not None and path.is_file()

    @functools.cached_property
    def _numba_type_(self) -> Any:  # asked by numba where a kernel calls this one
        return linking.callable_type(self.function, self.signature)

    def __reduce__(self) -> str:
        return str(self.__qualname__)  # type: ignore[attr-defined]  # the name to import it by


class Inner(Generic[P, R]):
    """A function for kernels to call, compiled into each of them for the types that it is called with.
    Called from Python it is the plain function, slow and easy to test."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.function: Callable[P, R] = inspect.unwrap(function)
        functools.update_wrapper(self, self.function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.function(*args, **kwargs)

    @functools.cached_property
    def _dispatcher(self) -> Any:
        import numba

        function = cache.named_by_version(self.function, cache.version(self.function))
        return numba.njit(**OPTIONS, no_cpython_wrapper=True, pipeline_class=linking.inner_compiler())(function)

    @property
    def _numba_type_(self) -> Any:
        import numba

        return numba.types.Dispatcher(self._dispatcher)

    def described(self) -> tuple[str, Callable[..., Any] | None]:
        """How it is compiled, and its function, which is compiled into those that call it."""
        return "inner", self.function

    def __reduce__(self) -> str:
        return str(self.__qualname__)  # type: ignore[attr-defined]  # the name to import it by


inner = Inner


@overload
def kernel(function: Callable[P, R]) -> Kernel[P, R]: ...
@overload
def kernel(
    *, holds_gil: bool = False, always_compiled: bool = False, name: str = ""
) -> Callable[[Callable[P, R]], Kernel[P, R]]: ...
def kernel(
    function: Callable[P, R] | None = None, *, holds_gil: bool = False, always_compiled: bool = False, name: str = ""
) -> Any:
    """Makes a function a `Kernel` of the types of its annotations.
    Arrays must be writable. holds_gil: of some microseconds, for which it keeps Python's lock: a thread that waits for
    it would wake too late to use them. always_compiled: also with FMTORCH_KERNELS=off, since Python would take hours.
    name: of one that a function makes for some other function, unique in its file."""
    if function is not None:
        return Kernel(function)

    def named(function: Callable[P, R]) -> Kernel[P, R]:
        if name:
            function = inspect.unwrap(function)
            function.__name__ = function.__qualname__ = name
        return Kernel(function, holds_gil, always_compiled)

    return named


def _compiled(uncompiled: Kernel[P, R], count: str) -> tuple[Callable[P, R], list[Kernel[..., Any]]]:
    """The compiled function of a kernel, whose address its cell holds from now on, and the kernels that it calls."""
    import numba

    function = uncompiled.function
    how = OPTIONS | {"nogil": not uncompiled.holds_gil}
    dispatcher: Any = numba.njit(**how)(cache.named_by_version(function, uncompiled.version))
    announce = functools.partial(begun, function.__name__, count=count)
    file = dispatcher._cache = cache.KernelFile(cache.path(function, uncompiled.version), announce)
    enabled = gc.isenabled()
    gc.disable()  # numba makes millions of objects, nearly all of which stay
    try:
        dispatcher.compile(uncompiled.signature)
    finally:
        file.release()
        if enabled:
            gc.enable()
    if file.compiled and sys.stderr.isatty():
        print(_CLEAR, end="", file=sys.stderr, flush=True)  # the line is taken back
    dispatcher.disable_compile()
    (result,) = dispatcher.overloads.values()
    linking.publish(function, result)
    compiled: Callable[P, R] = dispatcher
    return compiled, file.calls


@inner
def vector(n: int) -> Array:
    """(n,) float64, not initialised: numba compiles `np.empty` anew for each literal shape, this but once."""
    return np.empty(n)


@inner
def matrix(rows: int, columns: int) -> Array:
    """(rows, columns) float64, not initialised."""
    return np.empty((rows, columns))


# The door from batched tensors to kernels, which see the arrays of one pair

PAIRS_OF_A_THREAD = 8  # at least; a thread takes as long to begin as a kernel for a pair


def for_each_pair(
    function: Callable[..., None], tensors: Sequence[Tensor | None], *constants: Any, out: Tensor,
    kind: torch.dtype = torch.float32, group: Callable[..., Any] | None = None,
) -> Tensor:  # fmt: skip
    """`out` (B, ...) after function(row of each tensor, constants, row of out) for each of B pairs.
    Rows are C-contiguous arrays, floating ones of type `kind`; of what is not known (None) an empty one. group: the
    NamedTuple in which the function takes the rows. Pairs are shared out among threads. What is on another device is
    copied to the CPU, and `out`, which is there, comes back on the device of the first tensor; it is on no graph."""
    results = out.numpy()
    arrays = [_array(t, kind, len(results)) for t in tensors]

    def run_pairs(pairs: range) -> None:
        for pair in pairs:
            rows = [array[pair] for array in arrays]
            function(*(rows if group is None else [group(*rows)]), *constants, results[pair])

    parts = max(1, min(available(), len(results) // PAIRS_OF_A_THREAD))
    mapped(run_pairs, [range(first, len(results), parts) for first in range(parts)])
    return out.to(next(t.device for t in tensors if t is not None))


def _array(tensor: Tensor | None, kind: torch.dtype, pairs: int) -> np.ndarray:
    if tensor is None:
        return np.empty((pairs, 0), torch.empty(0, dtype=kind).numpy().dtype)
    if tensor.is_floating_point() and tensor.dtype != kind:
        tensor = tensor.to(kind)
    return as_array(tensor.cpu().contiguous())


def as_array(tensor: Tensor) -> np.ndarray:
    """A tensor on the CPU as an array, a view, on no graph."""
    return (tensor.detach() if tensor.requires_grad else tensor).numpy()


# Many kernels compiled by two processes, since numba compiles one function at a time in each. The other process goes
# through the same kernels from the last to the first and leaves out what the cache folder holds. Where the two meet,
# one waits for the other: each kernel's file has a lock.

HOME = Path(__file__).resolve().parents[2]
_together = threading.Lock()


def compile_together(kernels: Sequence[Kernel[..., Any]]) -> None:
    """Have kernels ready to be called; those that this machine has not compiled yet are compiled, with messages.
    An inner function is compiled in each process that needs it: kernels that share many should stand side by side, the
    slowest at both ends. Raises ImportError where numba cannot be imported."""
    if off() or all(each.ready for each in kernels):
        return
    with _together:
        absent = [each for each in kernels if not (each.ready or each.kept)]
        with _helped([*reversed(absent)]):
            for number, each in enumerate(absent, start=1):
                each.compiled_alone(f"{number} of {len(absent)}: ")
        for each in kernels:
            each.compiled()


@contextlib.contextmanager
def _helped(kernels: Sequence[Kernel[..., Any]]) -> Iterator[None]:
    """Within it another process compiles these kernels, too, where that can be started and is of use."""
    if len(kernels) < 2 or cores() < 2 or cache.folder() is None:
        yield
        return
    names = [f"{each.function.__module__}:{each.function.__qualname__}" for each in kernels]
    path = os.pathsep.join([str(HOME), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        helper = subprocess.Popen(
            [sys.executable, "-m", __name__, *names], env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        yield
        return
    with helper:
        try:
            yield
        finally:
            helper.terminate()


def main() -> None:
    """Compile the kernels that the arguments name, ``module:function``; end with the process that asked for it."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    for name in sys.argv[1:]:
        kernel = linking.kernel_of(*name.split(":"))
        if not kernel.kept:
            kernel.compiled_alone()


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()

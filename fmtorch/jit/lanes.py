"""Several numbers as one value, for kernels that do the same to many samples or matches at a time::

    @inner
    def add_product(a: Array, b: Array, out: Array) -> None:  # arrays (rows, LANES)
        for r in range(len(out)):
            store(out, r, load(out, r) + 2.0 * load(a, r) * load(b, r))

A value takes ``+ - * /`` and comparisons with another, of as many lanes, or with one number; a mask, which comparisons
make, takes ``& | ^ ~``. In a kernel these are instructions of the processor on vectors in registers, in the order in
which they are written; a loop over the lanes would have to ask first whether its arrays overlap, and hold its sums in
memory. From Python a value is an array that no operator changes."""

import functools
import inspect
import platform
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fmtorch.jit.kernel import OPTIONS, Array, Inner


class Value(np.ndarray):
    """A value of lanes in Python: as of numbers, ``a += b`` leaves another name of the same value as it was."""

    __iadd__, __isub__, __imul__ = np.ndarray.__add__, np.ndarray.__sub__, np.ndarray.__mul__  # type: ignore[assignment]
    __itruediv__ = np.ndarray.__truediv__  # type: ignore[assignment]
    __iand__, __ior__, __ixor__ = np.ndarray.__and__, np.ndarray.__or__, np.ndarray.__xor__  # type: ignore[assignment]


class LaneFunction(Inner[..., Any]):
    """A function of lanes: in Python that of arrays, in kernels the intrinsic of this name in `lane_instructions`."""

    def __init__(self, function: Callable[..., Any], *parameters: int) -> None:
        super().__init__(function)
        self.parameters = parameters

    def described(self) -> tuple[str, None]:
        """Its name and parameters: this folder counts into the version of every kernel."""
        return f"lanes {self.function.__name__}{self.parameters}", None

    @functools.cached_property
    def _numba_type_(self) -> Any:  # asked by numba where a kernel calls this function
        from fmtorch.jit import lane_instructions

        intrinsic = getattr(lane_instructions, self.function.__name__)
        return lane_instructions.type_of(intrinsic(*self.parameters) if self.parameters else intrinsic)


class Lanes(NamedTuple):
    """load(A, r): row r of an array (rows, lanes). fill(x): the same number in all lanes."""

    load: LaneFunction
    fill: LaneFunction


def lanes(count: int) -> Lanes:
    """The ways to values of so many lanes."""

    def load(A: Array, row: int) -> Any:
        return A[row].copy().view(Value)

    def fill(number: Any) -> Any:
        return np.full(count, number).view(Value)

    return Lanes(LaneFunction(load, count), LaneFunction(fill, count))


LANES = 8  # of float64: two vectors of AVX2, one of AVX-512
load, fill = lanes(LANES)


@LaneFunction
def store(A: Array, row: int, value: Any) -> None:
    """Makes a value row r of an array (rows, lanes), a mask that of booleans; of a tuple all rows from r on."""
    for k, each in enumerate(value if isinstance(value, tuple) else (value,)):
        A[row + k] = each


@LaneFunction
def where(mask: Any, this: Any, other: Any) -> Any:
    """This value in the lanes of the mask, the other elsewhere."""
    return np.where(mask, this, other).view(Value)


@LaneFunction
def sqrt(value: Any) -> Any:
    """The square root of each lane."""
    return np.sqrt(value)


@LaneFunction
def absolute(value: Any) -> Any:
    """The magnitude of each lane."""
    return np.abs(value)


@LaneFunction
def copysign(value: Any, sign: Any) -> Any:
    """The magnitudes of one value with the signs of the other."""
    return np.copysign(value, sign)


@LaneFunction
def any_lane(mask: Any) -> Any:
    """Whether the mask holds in any lane."""
    return bool(mask.any())


@LaneFunction
def added(value: Any) -> Any:
    """The sum of the lanes: of one half and the other lane by lane, until one number is left."""
    while len(value) > 1:
        half = len(value) // 2
        value = value[:half] + value[half:]
    return value[0]


class _Fused(Inner[[Any, Any, Any], Any]):
    """`fused`, compiled into one instruction where the processor has it."""

    def described(self) -> tuple[str, None]:
        """Its name: this folder counts into the version of every kernel."""
        return "fused", None

    @functools.cached_property
    def _dispatcher(self) -> Any:
        import numba
        from llvmlite import binding
        from numba.extending import intrinsic

        if not binding.get_host_cpu_features().get("fma", platform.machine() in ("arm64", "aarch64")):
            return numba.njit(**OPTIONS, no_cpython_wrapper=True)(self.function)

        @intrinsic  # type: ignore[untyped-decorator]
        def instruction(context: Any, b: Any, c: Any, a: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                return builder.fma(*values)

            return numba.types.float32(*[numba.types.float32] * 3), code

        def fused(a: Any, b: Any, c: Any) -> Any:
            return instruction(b, c, a)

        return numba.njit(**OPTIONS, no_cpython_wrapper=True)(inspect.unwrap(fused))


@_Fused
def fused(a: Any, b: Any, c: Any) -> Any:
    """a + b c of float32 numbers, rounded once, to float32."""
    return np.float32(np.float64(a) + np.float64(b) * np.float64(c))

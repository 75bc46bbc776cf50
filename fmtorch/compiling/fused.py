"""A product and a sum rounded once, in kernels and in Python."""

from __future__ import annotations

import functools
import inspect
import platform
from typing import Any

import numpy as np

from fmtorch.compiling.kernel import OPTIONS, Inner


class _Fused(Inner[[Any, Any, Any], Any]):
    """`fused`, compiled into one instruction where the processor has it."""

    def described(self) -> tuple[str, None]:
        """Its name: this file counts into the version of every kernel."""
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


def _fused(a: Any, b: Any, c: Any) -> Any:
    """a + b c of float32 numbers, rounded once, to float32."""
    return np.float32(np.float64(a) + np.float64(b) * np.float64(c))


fused = _Fused(_fused, inline=False)
